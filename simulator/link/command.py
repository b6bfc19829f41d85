"""`simulator link`: a server that a client in any language drives over shared memory.

simulator link --track forza --name /driverview
simulator link --header driverview_link.h
"""

import json
import signal
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from simulator.link.config import LinkConfig
from simulator.track.cli import Lanes, LaneWidth, Traffic
from trackfeatures.errors import UserError

Name = Annotated[str, typer.Option(help="Name of the shared memory, such as /driverview.")]
Track = Annotated[str, typer.Option(help="Name of a track, or a track file.")]
Frequency = Annotated[int, typer.Option(help="Control steps per second; a divisor of 200.")]
Seed = Annotated[
    int, typer.Option(help="Seed of scenery and light, and of resets without a seed.", min=0)
]
CameraSize = Annotated[str, typer.Option(help="Image size in pixels, such as 280x210, or none.")]
LightName = Annotated[str, typer.Option(help="Light of the images, such as clear or rain.")]
TracksDir = Annotated[Path | None, typer.Option(help="A further folder to search for tracks.")]
Realtime = Annotated[
    bool,
    typer.Option(
        "--realtime/--lock-step",
        help="Step by the wall clock and hold the last command, or wait for a command before each "
        "step.",
    ),
]
Once = Annotated[bool, typer.Option("--once", help="End when the first client disconnects.")]
Patience = Annotated[
    float,
    typer.Option(help="Longest wait for a client's command, s; then the server ends. 0: no limit."),
]
Header = Annotated[
    Path | None, typer.Option(help="Write the C header of the memory to this file and end.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def link(
    track: Track = LinkConfig.track,
    name: Name = LinkConfig.name,
    lanes: Lanes = LinkConfig.lanes,
    lane_width: LaneWidth = LinkConfig.lane_width,
    traffic: Traffic = LinkConfig.traffic,
    frequency: Frequency = LinkConfig.frequency_hz,
    seed: Seed = LinkConfig.seed,
    camera: CameraSize = "none",
    light: LightName = LinkConfig.light,
    tracks_dir: TracksDir = LinkConfig.tracks_dir,
    realtime: Realtime = LinkConfig.realtime,
    once: Once = LinkConfig.once,
    patience: Patience = LinkConfig.patience_s,
    header: Header = None,
    as_json: AsJson = False,
) -> None:
    """Run the simulator for a client in another process: C, Python, any language.

    A client sends a reset, then one command per control step; see driverview_link.h. Ctrl-C,
    SIGTERM or a client's QUIT request ends it.
    """
    if header is not None:
        _write_header(header)
        return
    config = LinkConfig(
        track=track,
        name=name,
        lanes=lanes,
        lane_width=lane_width,
        traffic=traffic,
        frequency_hz=frequency,
        seed=seed,
        picture=picture_size(camera),
        light=light,
        tracks_dir=tracks_dir,
        realtime=realtime,
        once=once,
        patience_s=patience,
    )
    _serve(config, as_json)


def _write_header(path: Path) -> None:
    from runtime.files import atomic_write
    from simulator.link.header import c_header

    atomic_write(path, c_header())


def _serve(config: LinkConfig, as_json: bool) -> None:
    from simulator.link.process import run

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    summary = run(config, lambda text: typer.echo(text, err=True))
    if as_json:
        typer.echo(json.dumps(asdict(summary)))
    else:
        typer.echo(
            f"{summary.steps} steps in {summary.episodes} episodes for {summary.clients} clients, "
            f"{summary.clients_lost} of them lost; {summary.refused} commands refused"
        )


def picture_size(text: str) -> tuple[int, int]:
    """(width, height) of "WxH", (0, 0) of "none". Raises UserError."""
    if text == "none":
        return 0, 0
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"--camera is {text!r}; give a size such as 280x210, or none")
    return int(width), int(height)

"""`simulator link`: an engine that a client in any language drives over shared memory.

simulator link --track forza --name /driverview
simulator link --header driverview_link.h
"""

import json
import signal
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from trackfeatures import LANE_WIDTH_M
from trackfeatures.errors import UserError


def link(
    track: Annotated[str, typer.Option(help="Name of a track, or a file of one.")] = "circuit",
    name: Annotated[str, typer.Option(help="Of the shared memory: /letters.")] = "/driverview",
    lanes: Annotated[int, typer.Option(help="Number of lanes, 1 to 3.")] = 1,
    lane_width: Annotated[float, typer.Option(help="Metres, 3.0 to 4.5.")] = LANE_WIDTH_M,
    traffic: Annotated[int, typer.Option(help="Number of other cars.", min=0, max=12)] = 0,
    frequency: Annotated[int, typer.Option(help="Control steps a second; divides 200.")] = 20,
    seed: Annotated[
        int, typer.Option(help="Of scenery, light and episodes without a seed.", min=0)
    ] = 0,
    camera: Annotated[str, typer.Option(help="Picture size such as 280x210, or none.")] = "none",
    light: Annotated[str, typer.Option(help="Light of the pictures, by name.")] = "clear",
    tracks_dir: Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")] = None,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime/--lock-step",
            help="Step by the clock, holding the last command; or wait for one each step.",
        ),
    ] = False,
    once: Annotated[bool, typer.Option("--once", help="End with the first client.")] = False,
    patience: Annotated[
        float,
        typer.Option(help="Seconds to bear with a living client that sends nothing; 0: any."),
    ] = 600.0,
    header: Annotated[
        Path | None, typer.Option(help="Write the C header of the memory there, and end.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Run the simulator for a client in another process: C, Python, anything.

    A client asks for a reset, then for one control step after the other; see driverview_link.h.
    Ctrl-C, SIGTERM or the client's request to quit ends it.
    """
    if header is not None:
        from runtime.files import atomic_write
        from simulator.link.header import c_header

        atomic_write(header, c_header())
        return
    from simulator.link.process import LinkConfig, run

    signal.signal(signal.SIGTERM, _interrupt)
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


def _interrupt(number: int, frame: object) -> None:
    """SIGTERM is Ctrl-C without a terminal."""
    raise KeyboardInterrupt

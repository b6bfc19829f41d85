"""The configuration of `controllers drive`: its options and their defaults."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from controllers import cli_options as options

THROTTLE = 0.2
"""The paper's constant throttle (0 to 1), in gear 1."""


@dataclass(frozen=True)
class DriveConfig:
    """One closed-loop drive. Equal configurations give equal drives, except with `realtime`."""

    controller: options.ControllerName = "lqr-preview"
    track: options.Track = "oval"
    lanes: Annotated[int, "Number of lanes, 1 to 3."] = 1
    perception: Annotated[
        str,
        "Perception: truth (the exact state), model, or the address of a service, e.g. "
        "http://127.0.0.1:8000.",
    ] = "truth"
    steps: options.Steps = None
    log: Annotated[Path | None, "CSV file for the state and the steering of each step."] = None
    video: Annotated[Path | None, "File for a film of the drive (.mp4)."] = None
    watch: Annotated[
        int | None,
        Option(
            metavar="PORT",
            min=0,
            max=65535,
            help="Show the drive in the browser in real time, at this port; 0: any free port.",
        ),
    ] = None
    latency_ms: options.Latency = 0.0
    drop: options.Drop = 0.0
    realtime: Annotated[
        bool,
        Option(
            "--realtime",
            help="Drive on the wall clock, without waiting for the perception's answers. "
            "The result differs from drive to drive.",
        ),
    ] = False
    parameters: options.Parameters = None
    model: options.Model = "default"
    views: options.Views = 1
    start_d: Annotated[
        float | None,
        "Start, m left of the track's centre. Default: the centre of --target-lane, or 0.",
    ] = None
    target_lane: Annotated[
        int | None, "Lane to follow, 0 is the leftmost. Default: the lane nearest to the start."
    ] = None
    throttle: Annotated[
        float | None,
        f"Constant throttle, 0 to 1, in gear 1. Default: {THROTTLE}. Not with --speed, which "
        "controls the throttle.",
    ] = None
    speed: Annotated[
        float | None,
        "Speed to hold, m/s, 1 to 40; the car slows down in bends and behind traffic. Default: the "
        "throttle is constant.",
    ] = None
    traffic: Annotated[int, "Number of other cars, 0 to 12."] = 0
    light: options.Light = "clear"
    seed: Annotated[
        int, Option(help="Seed of traffic, scenery, light and lost answers.", min=0)
    ] = 0
    tracks_dir: options.TracksDir = None

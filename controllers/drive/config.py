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
    """One closed-loop drive. Two drives with equal configurations are equal, unless `realtime` is
    set."""

    controller: options.ControllerName = "lqr-preview"
    track: options.Track = "oval"
    lanes: Annotated[int, "Number of lanes, 1 to 3."] = 1
    perception: Annotated[
        str,
        "Source of the state that the controller receives: truth (the simulator's exact state), "
        "model (the answers of --model to rendered images), or the address of a service that "
        "answers the images, for example http://127.0.0.1:8000.",
    ] = "truth"
    steps: options.Steps = None
    log: Annotated[
        Path | None,
        "CSV file to write the state of the car and the steering of each control step to. "
        "Default: none.",
    ] = None
    video: Annotated[Path | None, "MP4 file to write a film of the drive to. Default: none."] = None
    watch: Annotated[
        int | None,
        Option(
            metavar="PORT",
            min=0,
            max=65535,
            help="Show the drive in the browser in real time, at this port; 0: any free port. "
            "Default: it is not shown.",
        ),
    ] = None
    latency_ms: options.Latency = 0.0
    drop: options.Drop = 0.0
    realtime: Annotated[
        bool,
        Option(
            "--realtime",
            help="Drive on the wall clock, without waiting for the answers of the model or "
            "service. The result differs from drive to drive.",
        ),
    ] = False
    parameters: options.Parameters = None
    model: options.Model = "default"
    views: options.Views = 1
    start_d: Annotated[
        float | None,
        "Start of the car, m to the left of the track's centre (negative: to the right). "
        "Default: the centre of the lane to follow.",
    ] = None
    target_lane: Annotated[
        int | None,
        "Number of the lane to follow; 0 is the leftmost. Default: the lane nearest to --start-d, "
        "or without --start-d the middle lane (of two lanes the right one).",
    ] = None
    throttle: Annotated[
        float | None,
        f"Constant throttle, 0 to 1, in gear 1. Default: {THROTTLE}. Not with --speed, "
        "which controls the throttle.",
    ] = None
    speed: Annotated[
        float | None,
        "Speed to hold, m/s, 1 to 40; the car slows down in bends and behind slower "
        "cars. Default: the throttle is constant instead.",
    ] = None
    traffic: Annotated[int, "Number of other cars, 0 to 12."] = 0
    light: options.Light = "clear"
    seed: Annotated[
        int,
        Option(
            help="Seed of the traffic, the scenery, the details of the light and the lost answers.",
            min=0,
        ),
    ] = 0
    tracks_dir: options.TracksDir = None

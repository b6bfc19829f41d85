"""The configurations of `controllers compare` and `controllers tune`: options and defaults."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from controllers import cli_options as options


@dataclass(frozen=True)
class CompareConfig:
    """A comparison: every controller on every track, with every perception and seed."""

    out: Annotated[Path, "Folder for results.json and report.html."] = Path("comparison")
    tracks: options.Tracks = "forza,alpine-2,eroad,g-track-3"
    controllers: options.Controllers = "lqr,lqr-preview,mpc,mpc-preview,torcs"
    perceptions: Annotated[
        str, "Perceptions, separated by commas: truth, model or addresses of services."
    ] = "truth"
    seeds: Annotated[
        int,
        "Number of times that each drive is repeated, with the seeds 0, 1, ... The seed "
        "changes images and disturbances. Drives with neither are all equal.",
    ] = 1
    disturb: Annotated[
        bool,
        Option(
            "--disturb",
            help="Add drives with sensor noise, delay, wind, and changed friction, mass and tyre "
            "stiffness.",
        ),
    ] = False
    steps: options.Steps = None
    start_d: Annotated[
        float | None,
        "Start, m left of the track's centre. Default: TORCS's position on the starting "
        "grid, a sixth of the track's width to the right.",
    ] = None
    latency_ms: options.Latency = 0.0
    drop: options.Drop = 0.0
    model: options.Model = "default"
    views: options.Views = 1
    light: options.Light = "clear"
    parameters: options.Parameters = None
    tracks_dir: options.TracksDir = None


@dataclass(frozen=True)
class TuneConfig:
    """A search for the parameters of several controllers, with the same number of drives for each
    controller."""

    out: Annotated[Path, "File for the parameters found."] = Path("tuned.json")
    controllers: Annotated[
        str,
        "Controllers, separated by commas: lqr, lqr-preview, lqr-paper, "
        "mpc, mpc-preview, lqr-kalman, mpc-kalman.",
    ] = "lqr,mpc"
    tracks: options.Tracks = "forza"
    budget: Annotated[
        int,
        "Number of drives of each controller on each track. The first drive has the controller's "
        "own parameters.",
    ] = 40
    reward: options.Reward = "paper"
    steps: options.Steps = None
    disturbance: Annotated[
        str, "Disturbance of the drives: none, noise, delay, wind, friction, mass or stiffness."
    ] = "none"
    seed: Annotated[int, Option(help="Seed of the candidates and the disturbance.", min=0)] = 0
    tracks_dir: options.TracksDir = None

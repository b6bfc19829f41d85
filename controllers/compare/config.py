"""The configurations of `controllers compare` and `controllers tune`: options and defaults."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from controllers.cli_options import (
    Controllers,
    Drop,
    Latency,
    Light,
    Model,
    Parameters,
    Reward,
    Steps,
    Tracks,
    TracksDir,
)


@dataclass(frozen=True)
class CompareConfig:
    """A comparison: every controller on every track, with every perception and seed."""

    out: Annotated[Path, Option(help="Folder for results.json and report.html.")] = Path(
        "comparison"
    )
    tracks: Tracks = "forza,alpine-2,eroad,g-track-3"
    controllers: Controllers = "lqr,lqr-preview,mpc,mpc-preview,torcs"
    perceptions: Annotated[
        str,
        Option(help="Perceptions, separated by commas: truth, model or addresses of services."),
    ] = "truth"
    seeds: Annotated[
        int,
        Option(
            help="Number of drives of each kind, with seeds 0, 1, ... On the truth without "
            "--disturb they are all equal."
        ),
    ] = 1
    disturb: Annotated[
        bool,
        Option(
            "--disturb",
            help="Add drives with sensor noise, delay, wind, and changed friction, mass and tyre "
            "stiffness.",
        ),
    ] = False
    steps: Steps = None
    start_d: Annotated[
        float | None,
        Option(
            help="Start, m left of the track's centre. Default: TORCS's place on the grid, a sixth "
            "of the track's width to the right."
        ),
    ] = None
    latency_ms: Latency = 0.0
    drop: Drop = 0.0
    model: Model = "default"
    light: Light = "clear"
    parameters: Parameters = None
    tracks_dir: TracksDir = None


@dataclass(frozen=True)
class TuneConfig:
    """A search for the parameters of several controllers with equal numbers of drives."""

    out: Annotated[Path, Option(help="File for the parameters found.")] = Path("tuned.json")
    controllers: Annotated[
        str,
        Option(
            help="Controllers, separated by commas: lqr, lqr-preview, lqr-paper, mpc, mpc-preview."
        ),
    ] = "lqr,mpc"
    tracks: Tracks = "forza"
    budget: Annotated[
        int,
        Option(
            help="Drives of each controller on each track; the first is with its own parameters."
        ),
    ] = 40
    reward: Reward = "paper"
    steps: Steps = None
    disturbance: Annotated[
        str,
        Option(
            help="Disturbance of the drives: none, noise, delay, wind, friction, mass or stiffness."
        ),
    ] = "none"
    seed: Annotated[int, Option(help="Seed of the candidates and the disturbance.", min=0)] = 0
    tracks_dir: TracksDir = None

"""The configurations of `controllers compare` and `controllers tune`: options and defaults."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from controllers import cli_options as options


@dataclass(frozen=True)
class CompareConfig:
    """A comparison: every controller on every track, with every perception and seed."""

    out: Annotated[Path, "Folder to write results.json and report.html to."] = Path("comparison")
    tracks: options.Tracks = "forza,alpine-2,eroad,g-track-3"
    controllers: options.Controllers = "lqr,lqr-preview,mpc,mpc-preview,torcs"
    perceptions: Annotated[
        str,
        "Sources of the state that the controllers receive, separated by commas: truth "
        "(the simulator's exact state), model (the answers of --model to rendered "
        "images), or addresses of services that answer the images.",
    ] = "truth"
    seeds: Annotated[
        int,
        "Number of times that each drive is repeated, with the seeds 0, 1, ... The seed "
        "changes the images and the disturbances; without images and disturbances all "
        "repetitions are equal.",
    ] = 1
    disturb: Annotated[
        bool,
        Option(
            "--disturb",
            help="Add drives with a disturbance, for each kind: sensor noise, delay, side "
            "wind, changed friction, mass and tyre stiffness.",
        ),
    ] = False
    steps: options.Steps = None
    start_d: Annotated[
        float | None,
        "Start of the car, m to the left of the track's centre (negative: to the right). "
        "Default: the first position on the starting grid in TORCS, which is a sixth of "
        "the track's width to the right of the centre.",
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

    out: Annotated[Path, "JSON file to write the parameters to."] = Path("tuned.json")
    controllers: Annotated[
        str,
        "Controllers, separated by commas: lqr, lqr-preview, lqr-paper, "
        "mpc, mpc-preview, lqr-kalman, mpc-kalman.",
    ] = "lqr,mpc"
    tracks: options.Tracks = "forza"
    budget: Annotated[
        int,
        "Number of parameter sets that are tried for each controller, with one drive on "
        "each track. The first set contains the controller's own parameters.",
    ] = 40
    reward: options.Reward = "paper"
    steps: options.Steps = None
    disturbance: Annotated[
        str,
        "Disturbance in all drives: none, noise (of the sensors), delay (of the state), "
        "wind (from the side), or changed friction, mass or stiffness (of the tyres).",
    ] = "none"
    seed: Annotated[
        int, Option(help="Seed of the random parameter sets and of the disturbance.", min=0)
    ] = 0
    tracks_dir: options.TracksDir = None

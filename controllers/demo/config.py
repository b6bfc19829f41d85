"""The configuration of `controllers demo`: its options, their defaults, and its fixed settings."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from trackfeatures.errors import UserError


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """The numbers of rounds and frames that the demo collects, and the time that it trains. With
    the defaults the demo takes about 20 minutes on two cores."""

    out: Annotated[Path, "Folder to write all results to."] = Path("demo")
    rounds: Annotated[
        int,
        Option(
            help="Number of rounds (recorded drives) to collect for training and testing.", min=12
        ),
    ] = 300
    frames: Annotated[int, Option(help="Number of frames in each round.", min=20)] = 200
    minutes: Annotated[float, Option(help="Duration of the training, minutes.", min=0.1)] = 8.5
    seed: Annotated[
        int, Option(help="Seed of all random choices of the collection and of the training.", min=0)
    ] = 1
    first_drive: Annotated[
        bool,
        Option(
            "--first-drive",
            help="Stop after the first step: a short drive that is recorded, and a film of it "
            "with the answers of the shipped model.",
        ),
    ] = False

    tracks: str = "circuit,forest,highway,mountain-pass,ring-road"
    alpha: str = "0.3,0.2,0.5"
    """Weights of the network's three tasks in the loss, as in the option `--alpha` of `mtlnet
    train`."""
    asked: int = 12
    """Number of held-out frames that are posted to the service."""
    drive_track: str = "highway"

    def __post_init__(self) -> None:
        if not math.isfinite(self.minutes):  # `min` allows infinity
            raise UserError(f"--minutes is {self.minutes}; give a finite number of 0.1 or more")

"""The configuration of an ablation: its fields are options of `mtlnet ablate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer import Option

import trackfeatures as tf
from mtlnet.training.recipes import find_recipe
from trackfeatures.errors import UserError


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse seeds such as "1,2,3". Raises UserError when a part is not a non-negative integer."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() for part in parts):
        raise UserError(f"--seeds {text!r} is not a list of whole numbers; give them as 1,2,3")
    return tuple(int(part) for part in parts)


@dataclass(frozen=True)
class AblationConfig:
    """Settings of an ablation. When an interrupted ablation is continued, only `seeds`, `device`
    and `threads` can differ."""

    out: Annotated[
        Path,
        Option(
            help="Folder to write the trainings and the table to; an interrupted ablation in it is "
            "continued."
        ),
    ]
    iterations: Annotated[int, Option(help="Number of steps of each training.")]
    data: Annotated[Path, Option(help="Folder of the dataset.")] = Path("datasets/default")
    seeds: Annotated[
        tuple[int, ...],
        Option(
            parser=parse_seeds,
            metavar="TEXT",
            help="Seeds of the trainings, separated by commas; each row of the table is "
            "trained once with each seed.",
        ),
    ] = (1, 2, 3)
    recipe: Annotated[
        str,
        Option(
            help="Named set of optimizer, learning rate, losses and augmentation: fast, or "
            "paper (as published)."
        ),
    ] = "fast"
    batch: Annotated[int, Option(help="Number of images in each training step.")] = 32
    split: Annotated[
        str,
        Option(
            help="Rounds of the dataset to evaluate on: test, or unseen (tracks that are kept for "
            "tests)."
        ),
    ] = "test"
    every: Annotated[
        int,
        Option(
            help="Step between two evaluated frames: 1 evaluates all frames, 5 every fifth frame.",
            min=1,
        ),
    ] = 5
    device: Annotated[
        str,
        Option(
            help="Device to train on: auto (a GPU if there is one, else the CPU), cpu, cuda or "
            "cuda:NUMBER."
        ),
    ] = "auto"
    threads: Annotated[int, Option(help="Number of CPU threads; 0: one per CPU core.")] = 0

    def __post_init__(self) -> None:
        if find_recipe(self.recipe).from_model:
            raise UserError(
                f"recipe {self.recipe} starts from a finished model; give --recipe fast or paper"
            )
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise UserError(f"--seeds {self.seeds} must be different numbers, at least one")

    def shared_settings(self) -> dict[str, Any]:
        """Return, by name, the settings that must be equal for runs to be comparable."""
        same = ("iterations", "recipe", "batch", "split", "every")
        return {"definitions": tf.VERSION, **{name: getattr(self, name) for name in same}}

"""The configuration of a training run: its fields are the options of `mtlnet train`.

The help shows the defaults of a new run; a resumed run keeps its stored values.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from mtlnet.architecture import find_architecture, require_task_heads
from mtlnet.training.losses.task_weights import Alpha, parse_alpha, require_method
from mtlnet.training.recipes import find_recipe
from trackfeatures.errors import UserError

CONFIG = "config.json"
MAX_THREADS = 1024


@dataclass(frozen=True)
class TrainConfig:
    """The options of one training run. Raises UserError for a value that is not allowed."""

    data: Annotated[
        Path,
        Option(
            help="Dataset folder or, with --init, a folder of images with a labels.csv.",
            show_default="datasets/default",
        ),
    ]
    out: Annotated[Path, Option(help="Folder of the run.", show_default="runs/DATE-RECIPE")]
    network: Annotated[
        str,
        Option(
            help="Architecture: grid, grid_residual, mtl (the paper's), deepdriving, "
            "mobilenet_v3_small or regnet_y_400mf.",
            show_default="grid; mtl for --recipe paper",
        ),
    ] = ""
    """A name of `mtlnet.architecture.ARCHITECTURES`."""
    alpha: Annotated[
        Alpha,
        Option(
            parser=parse_alpha,
            metavar="TEXT",
            help="Weights of the distance, angle and class losses; 0 leaves a task out.",
            show_default="0.3,0.2,0.5; 1,1,0 for deepdriving",
        ),
    ] = (0.3, 0.2, 0.5)
    balance: Annotated[
        str,
        Option(
            help="Method that sets the task weights: fixed (the values of --alpha), uncertainty or "
            "dwa; uncertainty and dwa use --alpha only to select tasks."
        ),
    ] = "fixed"
    recipe: Annotated[
        str,
        Option(
            help="Training recipe: fast (minutes), paper (days); with --init: tune (fine-tune on "
            "few images) or continue (hours on new frames).",
            show_default="fast; tune when --init is given",
        ),
    ] = "fast"
    iterations: Annotated[
        int | None,
        Option(
            help="Number of training steps.",
            show_default="the recipe's; no limit when --minutes is given",
        ),
    ] = None
    minutes: Annotated[
        float | None,
        Option(
            help="Duration of the training in minutes; the learning rate follows the elapsed time.",
            show_default="no limit",
        ),
    ] = None
    init: Annotated[
        str | None,
        Option(
            help="Model to start from: a run or a shipped model.",
            show_default="none: random weights",
        ),
    ] = None
    seed: Annotated[int, Option(help="Seed of all random numbers.")] = 0
    batch: Annotated[int, Option(help="Images per step.", show_default="the recipe's")] = 0
    rate_factor: float = 1.0
    """Factor by which the recipe's learning rate is multiplied: for a run started on a GPU, the
    result of `recipes.learning_rate_factor`. It is stored, so that a resumed run keeps its rate on
    any device."""
    device: Annotated[
        str, Option(help="Device: auto (a GPU if there is one), cpu, cuda or cuda:NUMBER.")
    ] = "auto"
    threads: Annotated[int, Option(help="Number of CPU threads.", show_default="one per core")] = 0
    skip_undecodable: Annotated[
        bool,
        Option(
            "--skip-undecodable",
            help="Leave out frames whose image cannot be decoded; the model's card lists them.",
        ),
    ] = False
    hold_out_drives: Annotated[
        str,
        Option(
            help="Drives of labels.csv to leave out of the training, separated by commas; "
            "`mtlnet evaluate` reports them separately.",
            show_default="none",
        ),
    ] = ""
    change_data: Annotated[
        bool,
        Option(
            "--change-data",
            help="With --resume: allow --data to be another dataset than at the start of the run.",
        ),
    ] = False

    def __post_init__(self) -> None:
        if not self.network:
            object.__setattr__(self, "network", find_recipe(self.recipe).network)
        require_task_heads(find_architecture(self.network), self.alpha)
        require_method(self.balance)
        if self.batch == 0:
            object.__setattr__(self, "batch", find_recipe(self.recipe).batch)
        if (self.init is not None) != find_recipe(self.recipe).from_model:
            raise UserError(
                f"recipe {self.recipe} starts from new weights; with --init give --recipe tune or "
                "continue"
                if self.init is not None
                else f"recipe {self.recipe} starts from a finished model; give it with --init"
            )
        if self.iterations is not None and self.iterations < 1:
            raise UserError(f"--iterations is {self.iterations}; give at least 1")
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise UserError(f"--minutes is {self.minutes}; give a number above 0")
        least = 2 if self._has_batch_norm() else 1
        if self.batch < least:
            reason = "batch normalisation needs" if least == 2 else "give"
            raise UserError(f"--batch is {self.batch}; {reason} at least {least}")
        if self.seed < 0:
            raise UserError(f"--seed is {self.seed}; give 0 or more")
        if not 0 <= self.threads <= MAX_THREADS:
            raise UserError(
                f"--threads is {self.threads}; give 0 (one a core) or at most {MAX_THREADS}"
            )

    def _has_batch_norm(self) -> bool:
        """Whether the network is trained with batch normalisation."""
        backbone = find_architecture(self.network).backbone
        return find_recipe(self.recipe).batch_norm or (bool(backbone) and self.init is None)

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
            help="Folder of a dataset or, with --init, a folder of images with labels.csv.",
            show_default="datasets/default",
        ),
    ]
    out: Annotated[
        Path,
        Option(
            help="Folder to write the model, its checkpoints and its curves to.",
            show_default="runs/DATE-RECIPE",
        ),
    ]
    network: Annotated[
        str,
        Option(
            help="Architecture of the network: grid, grid_residual (grid with six more "
            "convolutions), mtl (the paper's), deepdriving (Chen et al. 2015), "
            "mobilenet_v3_small or regnet_y_400mf (of torchvision).",
            show_default="grid; mtl for --recipe paper; the model's with --init",
        ),
    ] = ""
    """A name of `mtlnet.architecture.ARCHITECTURES`."""
    alpha: Annotated[
        Alpha,
        Option(
            parser=parse_alpha,
            metavar="TEXT",
            help="Weights of the losses of the three tasks, as three numbers of 0 or more "
            "separated by commas: distances, angle, class of the road. A task with weight "
            "0 is not trained.",
            show_default="0.3,0.2,0.5; 1,1,0 for deepdriving; the model's with --init",
        ),
    ] = (0.3, 0.2, 0.5)
    balance: Annotated[
        str,
        Option(
            help="Method that sets the weights of the tasks: fixed (the values of --alpha), "
            "uncertainty (Kendall et al. 2018) or dwa (dynamic weight average, Liu et al. "
            "2019). With uncertainty and dwa, --alpha only selects the tasks."
        ),
    ] = "fixed"
    recipe: Annotated[
        str,
        Option(
            help="Named set of optimizer, learning rate, losses and augmentation: fast (takes "
            "minutes) or paper (as published; takes days). With --init: tune (trains a "
            "model further on few images) or continue (trains a model further for hours "
            "on new frames).",
            show_default="fast; tune when --init is given",
        ),
    ] = "fast"
    iterations: Annotated[
        int | None,
        Option(
            help="Number of training steps.",
            show_default="3,000 for fast, 150,000 for paper, 500 for tune, 30,000 for continue; no "
            "limit when --minutes is given",
        ),
    ] = None
    minutes: Annotated[
        float | None,
        Option(
            help="Duration of the training, minutes. The learning rate then follows the "
            "elapsed time instead of the number of steps.",
            show_default="no limit",
        ),
    ] = None
    init: Annotated[
        str | None,
        Option(
            help="Model to train further: the folder of a training, its name in runs/, "
            '"latest" for the newest training, or a model that is shipped with the project: '
            '"default" or "varied".',
            show_default="none: the weights are random at the start",
        ),
    ] = None
    init_share: Annotated[
        float,
        Option(
            help="Share of the --init model in the result, 0 to less than 1: each weight of the "
            "result is a weighted mean of the weight before and the weight after the training. "
            "With recipe tune, 0.5 often lowers the errors and keeps more of what the model could "
            "do before."
        ),
    ] = 0.0
    seed: Annotated[int, Option(help="Seed of all random numbers, 0 or more.")] = 0
    batch: Annotated[
        int,
        Option(
            help="Number of images in each training step.",
            show_default="64 for fast and continue (256 on a GPU), 32 for paper and tune",
        ),
    ] = 0
    rate_factor: float = 1.0
    """Factor by which the recipe's learning rate is multiplied: for a run started on a GPU, the
    result of `recipes.learning_rate_factor`. It is stored, so that a resumed run keeps its rate on
    any device."""
    device: Annotated[
        str,
        Option(
            help="Device to train on: auto (a GPU if there is one, else the CPU), cpu, cuda or "
            "cuda:NUMBER."
        ),
    ] = "auto"
    threads: Annotated[
        int, Option(help="Number of CPU threads, 1 to 1024.", show_default="one per core")
    ] = 0
    skip_undecodable: Annotated[
        bool,
        Option(
            "--skip-undecodable",
            help="Leave out frames whose image cannot be decoded, and list them in the model's "
            "card.json. Without this option such a frame ends the training with an error.",
        ),
    ] = False
    hold_out_drives: Annotated[
        str,
        Option(
            help="Names of drives (column drive of labels.csv) whose images are left out of "
            "the training, separated by commas. A name that contains commas is given as it "
            "is. `mtlnet evaluate` reports the errors on them separately.",
            show_default="none",
        ),
    ] = ""
    change_data: Annotated[
        bool,
        Option(
            "--change-data",
            help="With --resume: allow another dataset as --data than at the start of the "
            "training, of the same camera, another split of the dataset, and other values of "
            "--hold-out-drives and --skip-undecodable. For another folder as --data, these two "
            "options have their defaults unless they are given.",
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
        if not 0 <= self.init_share < 1:
            raise UserError(f"--init-share is {self.init_share}; give 0 or more, but less than 1")
        if self.init_share and self.init is None:
            raise UserError("--init-share needs a finished model; give it with --init")
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

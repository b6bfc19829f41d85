"""Training recipes: `paper` as published, `fast` for a good model in minutes, `continue` to train a
finished model further for hours, `tune` to fine-tune a model on few images.

`paper`: SGD with momentum 0.9, batch 32, learning rate 0.001 times 0.9 every 10,000 steps, 150,000
steps. Dropout 0.5 and L2 5e-4 are our choice, because the paper states neither.

`fast` differs from `paper` as follows.

- Batch normalisation of the convolutions in training, folded away afterwards: training is several
times faster. The shared layers are not normalised: batch statistics add noise to the distances.
The statistics are frozen in the last part of a run: the last convolutions have only some hundred
positions per batch, and the network is then trained in the form in which it is used.
- The first two convolutions are frozen after a part of the run (FreezeOut, Brock et al. 2017): they
converge early and take nearly nine tenths of a backward pass. The time saved is used for more
steps.
- The unit of each output and of its loss is the standard deviation of the target. In coded units
the angle would hardly be learned, because its standard deviation is only 0.03, against 0.2 for a
distance.
- Muon for the large layers (`mtlnet.training.optimizers`): in short trials it needed half as many
images for the same errors. The learning rate warms up, then falls to zero along a cosine. With
twice this learning rate the distance errors are larger by 2 to 28 % after 5 minutes on one core and
by 9 to 43 % after 17 minutes. A batch has 64 images instead of 32, because Muon's own cost does not
depend on the size of the batch.
- Huber losses with gains (`HuberLoss`) replace squared errors: `l`, `m` and `r` jump where they
become absent, and a squared error favours a value in between.
- No dropout: it adds noise to outputs that must be accurate to a few per cent.
- Images are mirrored, rotated, partly covered and changed in brightness, contrast and tint, with
their labels (`mtlnet.data.augment.pipeline`), because a dataset has few rounds and a network
overfits their scenery.

`continue`: `fast` starting from a finished model (`--init`), for hours on new frames. Batch
normalisation is restored first, and the network may get more residual convolutions
(`mtlnet.model.pretrained`). The first convolution stays frozen. Frames in sharp bends and near a
change of class, where most errors occur, appear twice in an epoch. In a pilot of 5 minutes this
reduced the number of wrong classes to 0.89 and the angle's error to 0.97 of their former values.
With a learning rate of 1e-3 the model lost more of its former training than it gained by the new
frames. The learning rate is constant until the last fifth of the run, then
falls to zero as one minus a square root (Hägele et al. 2024, "Scaling Laws and Compute-Optimal
Training Beyond Fixed Training Durations"). So a run that is stopped before its last fifth can be
prolonged (`--resume --minutes`), with the same result as if it had been started with the longer
duration.

On a GPU `fast` and `continue` take `gpu_batch` images per step unless `--batch` is given, and every
recipe scales its learning rate by `learning_rate_factor`.

`tune`: `fast` starting from a finished model (`--init`), with AdamW, a fifth of the learning rate,
500 steps and no batch normalisation.
"""

import math
from dataclasses import dataclass, replace

from mtlnet.architecture import GRID, MTL
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class HuberLoss:
    """The Huber loss (Huber 1964) of errors in standard deviations of their targets, with gains.

    An error is squared up to `distance_beta` or `angle_beta` standard deviations and linear beyond.
    Where a distance has two possible values, the Huber loss is minimal at the likelier value, while
    the squared error is minimal in between. The angle does not jump, so its beta is large.

    The gains multiply the terms of distance and angle. Without gains the cross-entropy of the
    class, which stays large, outweighs both terms. With gains the distances are learned far better,
    and no task is learned worse (docs/experiments/task-weights.md).
    """

    distance_beta: float
    angle_beta: float = 1.0
    distance_gain: float = 2.5
    angle_gain: float = 5.0


@dataclass(frozen=True)
class Recipe:
    """Settings of a training, stored in the run's `config.json`."""

    name: str
    network: str
    """Default network of the recipe: the paper's network for recipe `paper`."""
    optimizer: str
    """Optimizer: sgd, adamw or muon (which uses AdamW for small layers)."""
    learning_rate: float
    batch: int
    """Images per step on a CPU."""
    iterations: int
    dropout: float
    l2: float
    """Weight of the L2 term |w|^2 (sgd), or decoupled weight decay (adamw, muon)."""
    batch_norm: bool
    standardise: bool
    """Whether the unit of each output and loss is the standard deviation of the target."""
    augment: bool
    freeze_bn_at: float = 1.0
    """Share of the run after which the statistics of batch normalisation are frozen."""
    huber: HuberLoss | None = None
    """Huber losses and their gains; None: squared errors without gains."""
    freeze_schedule: tuple[tuple[float, int], ...] = ()
    """Pairs (share, count): after this share of the run the first `count` convolutions are
    frozen."""
    hard_repeats: int = 1
    """Number of times that a hard frame (`mtlnet.data.road_ahead.hard_frames`) is used in an
    epoch."""
    from_model: bool = False
    """Whether the recipe starts from a finished model (`--init`)."""
    gpu_batch: int = 0
    """Images per step on a GPU, because small batches leave a part of it idle; 0: `batch`."""
    fall_from: float | None = None
    """Share of the run up to which the learning rate is constant after the warm-up (adamw, muon).
    None: the rate falls along a cosine after the warm-up."""


HUBER = HuberLoss(distance_beta=0.05)
FAST = Recipe(
    "fast",
    GRID.name,
    "muon",
    learning_rate=5e-4,
    batch=64,
    iterations=3_000,
    dropout=0.0,
    l2=2e-2,
    batch_norm=True,
    standardise=True,
    augment=True,
    freeze_bn_at=0.6,
    huber=HUBER,
    freeze_schedule=((0.3, 1), (0.6, 2)),
    gpu_batch=256,
)
CONTINUE = replace(
    FAST,
    name="continue",
    learning_rate=3e-4,
    iterations=30_000,
    hard_repeats=2,
    freeze_bn_at=0.8,
    freeze_schedule=((0.0, 1), (0.8, 2)),
    from_model=True,
    fall_from=0.8,
)
TUNE = replace(
    FAST,
    name="tune",
    optimizer="adamw",
    learning_rate=1e-4,
    batch=32,
    iterations=500,
    batch_norm=False,
    freeze_bn_at=1.0,
    freeze_schedule=(),
    from_model=True,
    gpu_batch=0,
)
RECIPES = {
    "paper": Recipe("paper", MTL.name, "sgd", 1e-3, 32, 150_000, 0.5, 5e-4, False, False, False),
    **{recipe.name: recipe for recipe in (FAST, CONTINUE, TUNE)},
}
MOMENTUM = 0.9
WARM_UP = 0.05
"""Share of a run over which the learning rate rises (adamw, muon)."""
WARM_UP_STEPS = 500
"""Maximum number of warm-up steps if the rate is constant afterwards: longer runs do not need more,
and a prolonged run must not warm up again."""
DECAY, DECAY_STEPS = 0.9, 10_000
"""Factor by which the learning rate is multiplied, and number of steps between two multiplications
(sgd)."""


def find_recipe(name: str) -> Recipe:
    """Return the recipe called `name`. Raises UserError when there is none."""
    if name not in RECIPES:
        raise UserError(f"there is no recipe {name!r}; choose one of {', '.join(RECIPES)}")
    return RECIPES[name]


def frozen_convolutions(recipe: Recipe, progress: float) -> int:
    """Return how many of the first convolutions are frozen at `progress` in [0, 1] of the run."""
    return max((count for share, count in recipe.freeze_schedule if progress >= share), default=0)


def learning_rate_factor(recipe: Recipe, batch: int) -> float:
    """Return the ratio of the learning rate for `batch` images per step to the recipe's own.

    SGD: the ratio r of the batch sizes (Goyal et al. 2017, "Accurate, Large Minibatch SGD"). AdamW
    and Muon: sqrt(r), because the length of their steps does not depend on the length of the
    gradient (Krizhevsky 2014). Malladi et al. 2022 ("On the SDEs and Scaling Rules for Adaptive
    Gradient Algorithms") derive sqrt(r) for Adam; they also scale the momenta, which is not done
    here.
    """
    ratio = batch / recipe.batch
    return ratio if recipe.optimizer == "sgd" else math.sqrt(ratio)


def learning_rate(recipe: Recipe, step: int, progress: float) -> float:
    """Return the learning rate at step number `step`, at `progress` in [0, 1] of the run."""
    if recipe.optimizer == "sgd":
        return recipe.learning_rate * DECAY ** (step // DECAY_STEPS)
    peak = recipe.learning_rate
    if recipe.fall_from is None:
        if progress < WARM_UP:
            # Not 0: a run limited by time starts at progress 0.
            return peak * max(progress / WARM_UP, 0.02)
        fall = (min(progress, 1.0) - WARM_UP) / (1 - WARM_UP)
        return peak * 0.5 * (1 + math.cos(math.pi * fall))
    rise = max(progress / WARM_UP, step / WARM_UP_STEPS, 0.02)
    fall = max(min(progress, 1.0) - recipe.fall_from, 0.0) / (1 - recipe.fall_from)
    return peak * min(rise, 1.0) * (1 - math.sqrt(fall))

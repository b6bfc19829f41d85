"""How a network is trained: the paper's recipe, and one that gives a good model in minutes.

`paper`: SGD with momentum 0.9, batch 32, learning rate 0.001 times 0.9 every 10,000 steps, 150,000
steps. Dropout 0.5 and L2 5e-4 are ours: the paper gives neither.

`fast`: what differs, and why.
- Batch normalisation of the convolutions in training, folded away afterwards: it speeds learning
  several times. Not of the shared layers: batch statistics are noise to a distance. So they are
  to the last convolutions, of whose few places a batch has but some hundred: in the last part of a
  run the statistics stay, and the network learns as what it will be.
- The first two convolutions learn for a part of the run only (FreezeOut, Brock et al. 2017): they
  are soon what they will be, and near nine tenths of a backward pass are theirs. What rests makes
  room for more steps.
- The heads answer in standard deviations of each target, and so does the loss: the coded angle
  varies by 0.03 where a coded distance varies by 0.2, and would hardly be learned beside it.
- Muon for the large layers (`mtlnet.training.optimizers`): in short trials half as many images for
  the same errors. The rate rises, then falls to nothing as a cosine over the run. Batches of 64,
  since its own work does not grow with the batch.
- A distance's error counts as it is, not squared, from a twentieth of a standard deviation on: `l`,
  `m` and `r` jump where they become inactive, and a squared error answers in between. The angle's
  counts squared, and both count more than a class's (`mtlnet.training.loss`).
- No dropout: it adds noise to what must come out as a number to a few per cent.
- Images mirrored, turned and covered in places, with labels that follow
  (`mtlnet.data.augment.pipeline`); other brightness, contrast and tint. Rounds are few: without it
  their scenery is learned by heart.

`tune`: `fast` from a finished model (`--init`): AdamW with a tenth of the rate, 500 steps, no
normalisation.
"""

import math
from dataclasses import dataclass

from trackfeatures.errors import UserError


@dataclass(frozen=True)
class Recipe:
    """One way to train; stored with the model."""

    name: str
    optimiser: str
    learning_rate: float
    batch: int
    iterations: int
    dropout: float
    l2: float
    """Weight of the L2 term |w|^2 (`paper`), or decoupled decay (`fast`)."""
    batch_norm: bool
    standardise: bool
    augment: bool
    settled: float = 1.0
    """From this share of the run on, batch normalisation keeps the statistics it has."""
    bend: float = 0.0
    """Errors count as they are, not squared, from so many standard deviations on; 0: never."""
    rests: tuple[tuple[float, int], ...] = ()
    """(share, count): from this share of the run on, the first `count` convolutions rest."""


RECIPES = {
    "paper": Recipe("paper", "sgd", 1e-3, 32, 150_000, 0.5, 5e-4, False, False, False),
    "tune": Recipe("tune", "adamw", 1e-4, 32, 500, 0.0, 2e-2, False, True, True, bend=0.05),
    "fast": Recipe(
        "fast",
        "muon",
        learning_rate=1e-3,
        batch=64,
        iterations=3_000,
        dropout=0.0,
        l2=2e-2,
        batch_norm=True,
        standardise=True,
        augment=True,
        settled=0.6,
        bend=0.05,
        rests=((0.3, 1), (0.6, 2)),
    ),
}
MOMENTUM = 0.9
WARM_UP = 0.05
DECAY, DECAY_STEPS = 0.9, 10_000


def find_recipe(name: str) -> Recipe:
    """The recipe of that name; UserError when there is none."""
    if name not in RECIPES:
        raise UserError(f"there is no recipe {name!r}; choose one of {', '.join(RECIPES)}")
    return RECIPES[name]


def resting(recipe: Recipe, progress: float) -> int:
    """How many of the first convolutions rest where `progress` in [0, 1] of the run is done."""
    return max((count for share, count in recipe.rests if progress >= share), default=0)


def learning_rate(recipe: Recipe, step: int, progress: float) -> float:
    """The rate at `step`, where `progress` in [0, 1] of the run is done."""
    if recipe.optimiser == "sgd":
        return recipe.learning_rate * DECAY ** (step // DECAY_STEPS)
    if progress < WARM_UP:
        # Never 0: a run that is timed starts at progress 0.
        return recipe.learning_rate * max(progress / WARM_UP, 0.02)
    fall = (min(progress, 1.0) - WARM_UP) / (1 - WARM_UP)
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * fall))

"""The tasks, their weights (`--alpha`), and the methods that set the weights (`--balance`,
`mtlnet.training.losses.task_weighting`)."""

import math

from trackfeatures.errors import UserError

TASKS = ("distance", "angle", "heading")
Alpha = tuple[float, float, float]
METHODS = ("fixed", "uncertainty", "dwa")


class AlphaError(UserError):
    """Raised for task weights that are missing, negative, not numbers, or all zero."""


def parse_alpha(text: str) -> Alpha:
    """Parse the weights of the three tasks from `text` of the form "distance,angle,class".

    A weight is 0 or more, and 0 leaves a task out; the weights can have any sum. Raises AlphaError.
    """
    parts = [part.strip() for part in text.split(",")]
    how = "give three weights for distance, angle and heading, such as --alpha 0.3,0.2,0.5"
    if len(parts) != len(TASKS):
        raise AlphaError(f"alpha has {len(parts)} weight(s) ({text!r}); {how}")
    try:
        distance, angle, heading = (float(part) for part in parts)
    except ValueError:
        raise AlphaError(
            f"alpha {text!r} has a weight that is missing or not a number; {how}"
        ) from None
    for task, weight in zip(TASKS, (distance, angle, heading), strict=True):
        if not math.isfinite(weight) or weight < 0:
            raise AlphaError(
                f"alpha's weight for {task} is {weight:g}; it must be 0 or more; {how}"
            )
    if distance == angle == heading == 0:
        raise AlphaError(f"alpha {text!r} leaves nothing to learn; give at least one task a weight")
    return distance, angle, heading


def require_method(name: str) -> str:
    """Return `name` if it is "fixed", "uncertainty" or "dwa". Raises UserError otherwise."""
    if name not in METHODS:
        raise UserError(f"there is no balance {name!r}; choose one of {', '.join(METHODS)}")
    return name

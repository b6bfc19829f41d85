"""The state vector that an actor receives. Training and driving use the same four definitions:

- `paper` has the paper's seven numbers (`trackfeatures.state_vector`): d/w (offset over half the
  width of the track), angle/pi, v_x and v_y over 75 km/h, and the class of the road, one-hot.
- `stacked` has the first four numbers of `paper`, the class of the road as one number (left 1,
  straight 0, right -1), the yaw rate (rad/s), the changes of d/w and angle/pi since the last step,
  and the last two steering actions. The curvature of the road can be inferred from `stacked`, but
  not from `paper`. LQR also receives the yaw rate.
- `residual` has the numbers of `stacked` and the steering of the controller `lqr`. The car is
  steered by the steering of `lqr` plus 0.3 times the actor's action (residual reinforcement
  learning, Johannink et al. 2019).
- `history` has the paper's state of the present step, and the differences between the states of
  the seven steps before and the present state. Noise, delay and the car's motion can be inferred.

Every drive divides the lateral offset by half the width of the track of the training. A controller
does not know the width of the road, and the actor was trained for offsets in this unit.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controllers.interface import Controller, LoopConfig, Observation
from trackfeatures.errors import UserError
from trackfeatures.state_vector import state_vector

Vector = NDArray[np.float32]
STEP_S = 0.05
"""Duration (s) of a control step in the trainings; an actor must drive with the same control
step."""
EXACT = LoopConfig(STEP_S)
RESIDUAL_REACH = 0.3
"""Steering action that the actor's action 1 adds to the steering of LQR. A bend of 25 m radius
needs a steering action of about 0.3."""


@dataclass(frozen=True)
class StateDefinition:
    """The numbers of a state: their names, their typical sizes, and how they change when left and
    right are exchanged."""

    name: str
    parts: tuple[str, ...]
    spread: tuple[float, ...]
    """Typical size of each number; some algorithms divide the number by it."""
    odd: tuple[float, ...]
    """-1 for a number that changes its sign when left and right are exchanged, 1 otherwise."""
    order: tuple[int, ...]
    """Index of the number that replaces each number when left and right are exchanged."""

    @property
    def size(self) -> int:
        return len(self.parts)


PAPER = StateDefinition(
    name="paper",
    parts=("d", "angle", "v_x", "v_y", "left", "straight", "right"),
    spread=(0.1, 0.04, 1.0, 0.04, 1.0, 1.0, 1.0),
    odd=(-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, 1.0),
    order=(0, 1, 2, 3, 6, 5, 4),
)
STACKED = StateDefinition(
    name="stacked",
    parts=(
        *("d", "angle", "v_x", "v_y", "turn", "yaw_rate"),
        *("d_change", "angle_change", "steer_1", "steer_2"),
    ),
    spread=(0.1, 0.04, 1.0, 0.04, 1.0, 0.4, 0.02, 0.01, 0.4, 0.4),
    odd=(-1.0, -1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0),
    order=tuple(range(10)),
)
RESIDUAL = StateDefinition(
    name="residual",
    parts=(*STACKED.parts, "lqr"),
    spread=(*STACKED.spread, 0.4),
    odd=(*STACKED.odd, -1.0),
    order=tuple(range(11)),
)
HISTORY_STEPS = 8
_CHANGE = (0.01, 0.005, 0.01, 0.01)
"""Typical changes of the first four numbers of the paper's state per step."""
HISTORY = StateDefinition(
    name="history",
    parts=(
        *PAPER.parts,
        *(f"{part}_{back}" for back in range(1, HISTORY_STEPS) for part in PAPER.parts),
    ),
    spread=(
        *PAPER.spread,
        *(
            spread
            for back in range(1, HISTORY_STEPS)
            for spread in (*(back * change for change in _CHANGE), 1.0, 1.0, 1.0)
        ),
    ),
    odd=PAPER.odd * HISTORY_STEPS,
    order=tuple(PAPER.size * back + k for back in range(HISTORY_STEPS) for k in PAPER.order),
)
STATES = {state.name: state for state in (PAPER, STACKED, RESIDUAL, HISTORY)}


def find_state(name: str) -> StateDefinition:
    """Return the definition called `name`. Raises UserError for an unknown name."""
    if name not in STATES:
        raise UserError(f"there is no state {name!r}; use one of: {', '.join(STATES)}")
    return STATES[name]


def paper_state(seen: Observation, half_width: float) -> Vector:
    """Return the paper's state (7,) of an observation: d/w, angle/pi, v_x and v_y over 75 km/h, and
    the class of the road, one-hot.

    `half_width` is w, half the width (m) of the track of the training.
    """
    return state_vector(
        *(seen.to_lane_centre, seen.angle, seen.vx, seen.vy, seen.heading), half_width=half_width
    ).astype(np.float32)


def history_state(recent: Vector) -> Vector:
    """Return the state `history` (..., 56) from the paper's states (..., 8, 7) of the last eight
    steps, newest first."""
    now, before = recent[..., :1, :], recent[..., 1:, :]
    whole: Vector = np.concatenate((now, before - now), axis=-2)
    return whole.reshape(*recent.shape[:-2], HISTORY.size)


class StateBuilder:
    """Builds the state vector of each control step of one drive, and stores the values that the
    states of later steps need."""

    def __init__(self, definition: StateDefinition, loop: LoopConfig = EXACT) -> None:
        self._plain = definition.name == PAPER.name
        self._recent: deque[Vector] | None = None
        if definition.name == HISTORY.name:
            self._recent = deque(maxlen=HISTORY_STEPS)
        self._lqr: Controller | None = None
        if definition.name == RESIDUAL.name:
            from controllers.laws.lqr import (
                Lqr,
                approach_limit,
            )  # loads scipy, which the other states do not need

            self._lqr = Lqr(STEP_S, approach_rad=approach_limit(loop))
        self._lqr_steer = 0.0
        self._before: tuple[float, float] | None = None
        self._steers = (0.0, 0.0)

    def build(self, paper: Vector, observation: Observation) -> Vector:
        """Return the state (size,) of a step from its paper's state (7,) and its observation."""
        if self._plain:
            return paper
        if self._recent is not None:
            missing = 1 if self._recent else HISTORY_STEPS  # the first state fills the past
            self._recent.extendleft([paper] * missing)
            return history_state(np.array(self._recent))
        d, angle, v_x, v_y, left, _, right = paper.tolist()
        d_before, angle_before = self._before or (d, angle)
        self._before = (d, angle)
        numbers = [
            *(d, angle, v_x, v_y, left - right, observation.yaw_rate),
            *(d - d_before, angle - angle_before, *self._steers),
        ]
        if self._lqr is not None:
            self._lqr_steer = self._lqr.update(observation)
            numbers.append(self._lqr_steer)
        return np.array(numbers, np.float32)

    def steer(self, action: float) -> float:
        """Return the steering in [-1, 1] for the `action` that the actor chose in the state that
        the last call of `build` returned."""
        if self._lqr is not None:
            action = min(max(self._lqr_steer + RESIDUAL_REACH * action, -1.0), 1.0)
        self._steers = (action, self._steers[0])
        return action

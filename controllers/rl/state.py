"""What an actor sees: definitions of the state vector, shared by training and driving.

`paper`: the environment's seven numbers: d/w, angle/pi, v_x and v_y over 75 km/h, and the heading
class one-hot (left, straight, right).
`stacked`: d/w, angle/pi, v_x, v_y, left minus right, and the yaw rate (rad/s), which LQR gets too;
the changes of the first two since the step before, and the last two steering actions. From
these the curvature of the road can be inferred, which the paper's state does not hold.
`residual`: as `stacked`, and the steering of the controller `lqr`, to which 0.3 times the actor's
action is added (Johannink et al. 2019, residual reinforcement learning).

The lateral offset is divided by half the width of the track trained on, in every drive: a
controller does not know the width of the road, and its gains are per metre.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controllers.interface import Controller, LoopConfig, Observation
from trackfeatures.errors import UserError

Vector = NDArray[np.float32]
SPEED_SCALE_M_S = 75.0 / 3.6
PAPER_SIZE = 7
STEP_S = 0.05
EXACT = LoopConfig(STEP_S)
RESIDUAL_REACH = 0.3
"""What the action 1 adds to the steering of LQR, in [-1, 1]. A bend of 25 m takes about 0.3."""


@dataclass(frozen=True)
class StateDefinition:
    """Names, spreads and signs of a state's numbers."""

    name: str
    parts: tuple[str, ...]
    spread: tuple[float, ...]
    """Typical size of each number; an algorithm may divide by it."""
    odd: tuple[float, ...]
    """-1 for a number that changes its sign when left and right are exchanged, else 1."""
    order: tuple[int, ...]
    """Which number stands where when left and right are exchanged."""

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
STATES = {state.name: state for state in (PAPER, STACKED, RESIDUAL)}


def find_state(name: str) -> StateDefinition:
    """The definition `name`. Raises UserError where there is none."""
    if name not in STATES:
        raise UserError(f"there is no state {name!r}; use one of: {', '.join(STATES)}")
    return STATES[name]


def paper_state(observation: Observation, half_width: float) -> Vector:
    """The environment's state (7,) of an observation; half_width in m."""
    state = np.zeros(PAPER_SIZE, np.float32)
    state[0] = observation.to_lane_centre / half_width
    state[1] = observation.angle / math.pi
    state[2] = observation.vx / SPEED_SCALE_M_S
    state[3] = observation.vy / SPEED_SCALE_M_S
    state[4 + observation.heading] = 1.0
    return state


class StateBuilder:
    """Builds the state of each step of one drive; keeps what it needs of earlier steps."""

    def __init__(self, definition: StateDefinition, loop: LoopConfig = EXACT) -> None:
        self._plain = definition.name == PAPER.name
        self._lqr: Controller | None = None
        if definition.name == RESIDUAL.name:
            from controllers.lqr import Lqr, approach_limit  # scipy; the other states need none

            self._lqr = Lqr(STEP_S, approach_rad=approach_limit(loop))
        self._lqr_steer = 0.0
        self._before: tuple[float, float] | None = None
        self._steers = (0.0, 0.0)

    def build(self, paper: Vector, observation: Observation) -> Vector:
        """The state from the environment's (7,) and what a controller observes."""
        if self._plain:
            return paper
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
        """The steering in [-1, 1] for the actor's action after the last state."""
        if self._lqr is not None:
            action = min(max(self._lqr_steer + RESIDUAL_REACH * action, -1.0), 1.0)
        self._steers = (action, self._steers[0])
        return action

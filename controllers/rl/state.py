"""What an actor sees: definitions of the state vector, shared by training and driving.

`paper`: the environment's seven numbers: d/w, angle/pi, v_x and v_y over 75 km/h, and the heading
class one-hot (left, straight, right).
`stacked`: d/w, angle/pi, v_x, v_y, left minus right, and the yaw rate (rad/s), which LQR gets too;
the changes of the first two since the step before, and the last two steering actions. From
these the curvature of the road can be inferred, which the paper's state does not hold.

The lateral offset is divided by half the width of the track trained on, in every drive: a
controller does not know the width of the road, and its gains are per metre.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controllers.interface import Observation
from trackfeatures.errors import UserError

Vector = NDArray[np.float32]
SPEED_SCALE_M_S = 75.0 / 3.6
PAPER_SIZE = 7


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
STATES = {state.name: state for state in (PAPER, STACKED)}


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

    def __init__(self, definition: StateDefinition) -> None:
        self._stacked = definition.name == STACKED.name
        self._before: Vector | None = None
        self._steers = (0.0, 0.0)

    def build(self, paper: Vector, yaw_rate: float) -> Vector:
        """The state from the environment's (7,) and the yaw rate (rad/s)."""
        if not self._stacked:
            return paper
        before = paper if self._before is None else self._before
        self._before = paper
        return np.array(
            [
                *paper[:4],
                paper[4] - paper[6],
                yaw_rate,
                paper[0] - before[0],
                paper[1] - before[1],
                *self._steers,
            ],
            np.float32,
        )

    def steered(self, steer: float) -> None:
        """Tell the steering action that followed the last state."""
        self._steers = (steer, self._steers[0])

"""The paper's state vector, by its equations."""

import math

import numpy as np

from trackfeatures import RoadClass
from trackfeatures.state_vector import state_vector


def test_the_state_vector_is_the_papers() -> None:
    found = state_vector(1.5, -0.1, 15.0, -0.2, RoadClass.RIGHT, half_width=6.0)
    speeds = [15.0 * 3.6 / 75.0, -0.2 * 3.6 / 75.0]
    np.testing.assert_allclose(found, [0.25, -0.1 / math.pi, *speeds, 0.0, 0.0, 1.0], rtol=1e-15)

"""Quaternions of body axes equal PyBullet's, in all four branches of the conversion."""

import numpy as np
import pytest

from simulator.vehicle.orientation import quaternion, rotation

pytestmark = pytest.mark.contacts  # PyBullet is the oracle


@pytest.mark.parametrize(
    "euler",
    [(0.0, 0.0, 0.0), (3.1, 0.1, 0.2), (0.1, 0.2, 3.1), (3.0, 0.2, 3.0), (0.3, -1.2, -2.0)],
)
def test_quaternion_and_rotation_equal_pybullets(euler: tuple[float, float, float]) -> None:
    import pybullet

    turn = pybullet.getQuaternionFromEuler(euler)
    matrix = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
    forward, left, up = matrix.T
    ours = quaternion(forward, left, up)
    assert abs(float(np.dot(ours, turn))) == pytest.approx(1.0)  # q and -q are one orientation
    np.testing.assert_allclose(rotation(np.array(turn)), matrix.T, atol=1e-12)

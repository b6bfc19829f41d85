"""The intelligent driver model against its closed forms."""

import math

import pytest

from simulator.traffic.idm import (
    COMFORTABLE_ACCELERATION,
    COMFORTABLE_BRAKING,
    MAX_BRAKING,
    STANDSTILL_GAP_M,
    TIME_HEADWAY_S,
    idm_acceleration,
)


def test_acceleration_on_a_free_road() -> None:
    assert idm_acceleration(math.inf, 0.0, 0.0, 15.0) == COMFORTABLE_ACCELERATION
    assert idm_acceleration(math.inf, 15.0, 0.0, 15.0) == 0.0
    half = idm_acceleration(math.inf, 7.5, 0.0, 15.0)
    assert half == pytest.approx(COMFORTABLE_ACCELERATION * (1 - 1 / 16))
    assert idm_acceleration(math.inf, 40.0, 0.0, 10.0) == -COMFORTABLE_BRAKING


def test_no_acceleration_at_the_equilibrium_gap() -> None:
    """The gap at equal speeds is (s0 + v T) / sqrt(1 - (v/v0)^4) (Treiber, eq. 4)."""
    speed, desired = 10.0, 15.0
    gap = (STANDSTILL_GAP_M + speed * TIME_HEADWAY_S) / math.sqrt(1 - (speed / desired) ** 4)
    assert idm_acceleration(gap, speed, speed, desired) == pytest.approx(0.0, abs=1e-12)
    assert idm_acceleration(gap - 1, speed, speed, desired) < 0
    assert idm_acceleration(gap + 1, speed, speed, desired) > 0


def test_braking_grows_with_speed_and_proximity_up_to_its_limit() -> None:
    gaps = [idm_acceleration(g, 15.0, 10.0, 15.0) for g in (80.0, 40.0, 20.0, 10.0)]
    assert gaps == sorted(gaps, reverse=True)
    assert idm_acceleration(0.0, 15.0, 0.0, 15.0) == -MAX_BRAKING
    assert idm_acceleration(-3.0, 15.0, 15.0, 15.0) == -MAX_BRAKING
    assert idm_acceleration(math.inf, 0.0, 0.0, 0.0) == COMFORTABLE_ACCELERATION

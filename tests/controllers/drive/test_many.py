"""Many drives at once: the numbers of single drives, for every controller; ends; contacts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.compare.curves import CurveRecorder, curves_of
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES, Disturbance
from controllers.drive.many import Outcome, Task, can_join, drive_many
from controllers.drive.run import drive
from controllers.interface import Observation, Observations
from controllers.registry import CONTROLLERS
from trackfeatures import RoadClass, UserError

ALL = Disturbance(noise=True, delay_s=0.1, wind=True, friction=True, mass=True, stiffness=True)
LAWS = """
import numpy as np

class Held:  # the steering, held
    def __init__(self, steer=0.3):
        self.steer = steer
    def update(self, seen):
        return self.steer
    def update_batch(self, seen):
        return np.full(len(seen), self.steer)

class Dividing(Held):
    def update_batch(self, seen):
        return 1 / 0
"""


def task(controller: str, disturbance: Disturbance = ALL, **options: Any) -> Task:
    values: dict[str, Any] = {"track": "oval", "steps": 80, "start_d": -1.0} | options
    return DriveConfig(controller=controller, **values), disturbance


def at_once(tasks: Sequence[Task], parameters: dict[str, float] | None = None) -> list[Outcome]:
    outcomes = [one for batch in drive_many(tasks, parameters) for one in batch]
    return sorted(outcomes, key=lambda one: one.number)


def check_equal(tasks: Sequence[Task], parameters: dict[str, float] | None = None) -> list[Outcome]:
    """Drive the tasks at once, and compare each with a drive alone, bit for bit."""
    outcomes = at_once(tasks, parameters)
    for (config, disturbance), outcome in zip(tasks, outcomes, strict=True):
        assert can_join(config)
        curves = CurveRecorder()
        alone = drive(config, disturbance=disturbance, observers=[curves], parameters=parameters)
        assert outcome.result == alone
        assert curves_of(outcome.curves) == curves.curves()
    return outcomes


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_drive_has_the_numbers_of_a_drive_alone(controller: str) -> None:
    outcomes = check_equal(
        [
            task(controller, seed=1),
            task(controller, seed=2, track="town", steps=60),
            task(controller, DISTURBANCES["delay"], track="mountain-pass"),
        ]
    )
    assert len({str(one.result) for one in outcomes}) == 3


def test_a_drive_that_ends_early_is_that_of_a_drive_alone_and_the_others_go_on(
    tmp_path: Path,
) -> None:
    (tmp_path / "laws.py").write_text(LAWS)
    held, of = f"{tmp_path / 'laws.py'}:Held", DISTURBANCES["mass"]
    tasks = [task(held, of, steps=350, track="town", seed=k) for k in range(2)]
    tasks.append(task(held, of, steps=350, start_d=None, lanes=2, target_lane=1))
    found = [one.result for one in check_equal(tasks, {"steer": 0.0})]
    ends = [(one.ended, one.steps < 350) for one in found if not isinstance(one, UserError)]
    assert ends == [("off_track", True), (None, False), (None, False)]


@pytest.mark.contacts
def test_a_car_that_touches_a_wall_moves_as_alone(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(LAWS)
    held = f"{tmp_path / 'laws.py'}:Held"
    tasks = [task(held, DISTURBANCES["mass"], steps=300, seed=k) for k in range(2)]
    outcomes = check_equal(tasks, {"steer": 0.3})
    for one in outcomes:
        assert not isinstance(one.result, UserError)
        assert one.result.ended == "off_track"
        assert one.result.steps < 300


def test_an_error_of_update_batch_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(LAWS)
    with pytest.raises(
        UserError, match=r"update_batch.* failed: ZeroDivision.*laws.py, line 1"
    ) as caught:
        at_once([task(f"{tmp_path / 'laws.py'}:Dividing")])
    assert "\n" not in str(caught.value)


def test_a_drive_with_sensor_noise_is_noisy() -> None:
    check_equal([task("lqr", Disturbance(noise=True)), task("lqr", Disturbance())])
    assert drive(*task("lqr", steps=2)[:1], disturbance=Disturbance(noise=True)).noisy
    assert not drive(*task("lqr", steps=2)[:1], disturbance=Disturbance()).noisy


def test_steering_beyond_the_lock_by_a_rounding_is_clipped(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(LAWS)
    held = f"{tmp_path / 'laws.py'}:Held"
    check_equal([task(held, steps=5)], {"steer": 1.0 + 1e-7})
    lost = at_once([task(held, steps=5)], {"steer": 1.1})[0].result
    assert isinstance(lost, UserError)
    assert "update_batch returned 1.1 for this car in control step 0" in str(lost)


@pytest.mark.parametrize(
    "options",
    [
        {"perception": "model"}, {"latency_ms": 50.0}, {"drop": 0.1}, {"traffic": 1},
        {"speed": 10.0}, {"throttle": 0.3}, {"log": Path("log.csv")}, {"realtime": True},
    ],
)  # fmt: skip
def test_other_drives_are_driven_alone(options: dict[str, Any]) -> None:
    assert can_join(task("lqr", views=2)[0])
    assert not can_join(task("lqr", **options)[0])


def test_observations_are_columns_of_rows() -> None:
    first = Observation(0.5, 0.1, RoadClass.LEFT, 20.0, 0.3, 0.2)
    second = Observation(-0.5, 0.2, RoadClass.RIGHT, 10.0, -0.3, 0.1, 0.01)
    seen = Observations(np.vstack([Observations.of(one).rows for one in (first, second)]))
    assert len(seen) == 2
    assert seen.split() == [first, second]
    assert seen.split()[0].heading is RoadClass.LEFT
    for name in ("to_lane_centre", "angle", "heading", "vx", "vy", "yaw_rate"):
        assert getattr(seen, name).tolist() == [getattr(first, name), getattr(second, name)]
    assert np.isnan(seen.curvature[0])
    assert seen.curvature[1] == 0.01

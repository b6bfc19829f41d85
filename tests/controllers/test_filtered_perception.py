"""`controllers drive --filter`: filtered answers in the loop; the truth is not filtered."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from controllers.closed_loop import run_lap
from controllers.config import DriveConfig
from controllers.drive import drive
from controllers.filtered_perception import FilteredPerception
from controllers.interface import LoopConfig
from controllers.lqr import make_lqr
from controllers.perception import CameraPerception, Perceived
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures import UserError
from trackfeatures.camera import CameraParameters


class NoisyModel:
    """Answers the truth with white errors of 0.3 m and 0.03 rad, and says so."""

    camera = CameraParameters()

    def __init__(self, world: World) -> None:
        self._world, self._rng = world, np.random.default_rng(0)

    def render(self, pose: object, traffic: object) -> NDArray[np.uint8]:
        return np.zeros((1, 1, 3), np.uint8)

    def predict(self, image: NDArray[np.uint8]) -> dict[str, Any]:
        now = self._world.state
        return {
            "to_lane_centre_m": now.to_middle + 0.3 * self._rng.normal(),
            "angle_rad": now.angle + 0.03 * self._rng.normal(),
            "heading": {"left": 0.0, "straight": 1.0, "right": 0.0},
            "std": {"to_lane_centre": 0.3, "angle": 0.03},
        }

    def close(self) -> None:
        """Nothing is open."""


def test_a_filtered_drive_strays_less_on_noisy_answers() -> None:
    strayed, errors = [], []
    for filtered in (False, True):
        road = Road(find_track("oval", None), 1)
        with World(road, traffic=0, frequency_hz=20) as world:
            world.reset(seed=0)
            model = NoisyModel(world)
            camera: Any = model
            plain = CameraPerception(camera, model)
            perceive = FilteredPerception(plain) if filtered else plain
            error: list[float] = []

            def watched(world: World, perceive: Any = perceive, error: Any = error) -> Perceived:
                found: Perceived = perceive(world)
                assert found.to_lane_centre is not None
                error.append(found.to_lane_centre - world.state.to_middle)
                return found

            lqr = make_lqr(LoopConfig(0.05, noisy=True))
            result = run_lap(world, lqr, watched, 600, noisy=True)
        assert result.ended is None
        strayed.append(result.mean_abs_d_m)
        errors.append(float(np.std(error)))
    assert errors[1] < 0.5 * errors[0]
    assert strayed[1] < strayed[0]


def test_the_truth_is_not_filtered() -> None:
    with pytest.raises(UserError, match="--filter is for answers to images"):
        drive(DriveConfig(track="oval", steps=10, filter=True))

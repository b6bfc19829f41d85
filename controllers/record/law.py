"""The steering law of a recorded round: a controller on a model's perception.

Course, speed, traffic and light of the round are the same as in `datagen collect`. The controller
follows the course by the model's answer to each image, so that the car reaches the states to which
the model's errors lead (DAgger, Ross et al. 2011). The recorded labels are the simulator's truth.

Two inputs come from the simulator: the positions of the other cars, and the lane from which the
answered offset is measured, because an image shows only the lane that the car is in.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import trackfeatures as tf
from controllers.drive.closed_loop import HOLD_S, OffsetMemory
from controllers.interface import Controller, LoopConfig, Observation
from controllers.perception.perceived import Perceive
from controllers.perception.sources import CameraPerception, FeatureModel, LocalModel
from controllers.registry import make_controller
from simulator.vehicle.state import CarState

if TYPE_CHECKING:
    from datagen.planning.plan import RoundPlan
    from simulator.camera import Camera
    from simulator.world.world import World


class PerceivedLaw:
    """A `datagen.driving.scripted_driver.SteeringLaw` that steers by perception; m and rad."""

    def __init__(
        self, controller: str, loop: LoopConfig, perceive: Perceive, world: "World"
    ) -> None:
        self._name, self._loop = controller, loop
        self._perceive, self._world = perceive, world
        self.restart()

    def restart(self) -> None:
        """Make a new controller and a new, empty memory of the road."""
        self._controller: Controller = make_controller(self._name, self._loop)
        self._memory = OffsetMemory(round(HOLD_S / self._loop.dt))

    def road_curvature(self, state: CarState) -> float:
        """0, because the model does not predict the curvature. A controller that needs it estimates
        it."""
        return 0.0

    def steer(
        self, state: CarState, offset: float, curvature: float, path_angle: float = 0.0
    ) -> float:
        """The steering action towards the path at `offset`, which has `path_angle` to the road."""
        perceived = self._perceive(self._world)
        error = None
        if perceived.to_lane_centre is not None:
            error = self._from_middle(perceived.to_lane_centre, state.to_middle) - offset
        return self._controller.update(
            Observation(
                to_lane_centre=self._memory.fill(error),
                angle=perceived.angle + path_angle,
                heading=perceived.heading,
                vx=state.vx,
                vy=state.vy,
                yaw_rate=state.yaw_rate,
            )
        )

    def _from_middle(self, to_lane_centre: float, true: float) -> float:
        """The answered offset from the middle of the road; the lane is chosen by the `true` offset.

        The chosen lane brings the answer nearest to `true`, because near a marking the model can
        answer for the adjacent lane.
        """
        road = self._world.road
        centres = (tf.lane_centre(n, road.lanes, road.lane_width) for n in range(road.lanes))
        return min((c + to_lane_centre for c in centres), key=lambda offset: abs(offset - true))


@dataclass(frozen=True)
class MakePerceivedLaw:
    """A function that makes the law of a round; it is pickled for the recording processes."""

    controller: str
    model: str

    def __call__(self, plan: "RoundPlan", world: "World", camera: "Camera") -> PerceivedLaw:
        loop = LoopConfig(1.0 / world.frequency_hz, noisy=True, delay_s=0.0)
        perceive = CameraPerception(camera, _load(self.model))
        return PerceivedLaw(self.controller, loop, perceive, world)


@lru_cache(maxsize=1)
def _load(model: str) -> FeatureModel:
    """The model; it is loaded once in each process, for all its rounds."""
    return LocalModel(model)

"""The steering law of a recorded round: a controller on a model's perception.

Trajectory, speed, traffic and light of the round are the same as in `datagen collect`. The
controller follows the trajectory by the model's answer to each image, so that the car reaches the
states to which the model's errors lead (DAgger, Ross et al. 2011). The labels are the true values.

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
    """Steers a recorded round by perception, as a `datagen.driving.scripted_driver.SteeringLaw`."""

    def __init__(
        self, controller: str, loop: LoopConfig, perceive: Perceive, world: "World"
    ) -> None:
        self._name, self._loop = controller, loop
        self._perceive, self._world = perceive, world
        self.restart()

    def restart(self) -> None:
        """Make a new controller, and forget the last perceived offset."""
        self._controller: Controller = make_controller(self._name, self._loop)
        self._memory = OffsetMemory(round(HOLD_S / self._loop.dt))

    def road_curvature(self, state: CarState) -> float:
        """Return 0: the model does not predict the curvature, and controllers estimate it
        themselves."""
        return 0.0

    def steer(
        self, state: CarState, offset: float, curvature: float, path_angle: float = 0.0
    ) -> float:
        """Return the steering action in [-1, 1] towards a path, which is `offset` m left of the
        middle of the road and turned by `path_angle` rad to the left of the road.

        The path's `curvature` is not used. Of the true `state`, only the speeds, the yaw rate and
        the lane are used.
        """
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
        """Convert the model's offset from a lane's centre to an offset (m) from the road's middle.

        Near a marking the model can answer for the adjacent lane. Therefore the lane is chosen for
        which the result is nearest to the `true` offset.
        """
        road = self._world.road
        centres = (tf.lane_centre(n, road.lanes, road.lane_width) for n in range(road.lanes))
        return min((c + to_lane_centre for c in centres), key=lambda offset: abs(offset - true))


@dataclass(frozen=True)
class MakePerceivedLaw:
    """Makes the steering law of a round when called. The object is pickled for the recording
    processes."""

    controller: str
    model: str

    def __call__(self, plan: "RoundPlan", world: "World", camera: "Camera") -> PerceivedLaw:
        loop = LoopConfig(1.0 / world.frequency_hz, noisy=True, delay_s=0.0)
        perceive = CameraPerception(camera, _load(self.model))
        return PerceivedLaw(self.controller, loop, perceive, world)


@lru_cache(maxsize=1)
def _load(model: str) -> FeatureModel:
    """Load a model, once in each process for all its rounds."""
    return LocalModel(model)

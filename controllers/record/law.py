"""Steering a recorded round by a controller that sees the road through a model.

The round is that of `datagen collect`: its course over the road, its speed, traffic and light. The
controller follows the course on what the model answers to each image, so that the car gets to where
the model's errors lead (DAgger, Ross et al. 2011); the recorded labels are the simulator's truth.

Beside the images two things come from the simulator: which lane the answered offset is measured
from, as an image shows only the lane that the car is in, and where the other cars are.
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
    """A `datagen.driving.scripted_driver.SteeringLaw` that steers by perception, m and rad."""

    def __init__(
        self, controller: str, loop: LoopConfig, perceive: Perceive, world: "World"
    ) -> None:
        self._name, self._loop = controller, loop
        self._perceive, self._world = perceive, world
        self.restart()

    def restart(self) -> None:
        """Begin with a new controller and no memory of the road."""
        self._controller: Controller = make_controller(self._name, self._loop)
        self._memory = OffsetMemory(round(HOLD_S / self._loop.dt))

    def road_curvature(self, state: CarState) -> float:
        """Unknown: no image answers it. The controller estimates it, where it needs it."""
        return 0.0

    def steer(
        self, state: CarState, offset: float, curvature: float, path_angle: float = 0.0
    ) -> float:
        """The controller's action towards the path at `offset`, of `path_angle` to the road."""
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
        """The answered offset from the middle of the road, for the lane nearest to the `true` one.

        Near a marking the model may answer for the lane beside.
        """
        road = self._world.road
        centres = (tf.lane_centre(n, road.lanes, road.lane_width) for n in range(road.lanes))
        return min((c + to_lane_centre for c in centres), key=lambda offset: abs(offset - true))


@dataclass(frozen=True)
class MakePerceivedLaw:
    """Makes the law of a round; it is sent to the recording processes."""

    controller: str
    model: str

    def __call__(self, plan: "RoundPlan", world: "World", camera: "Camera") -> PerceivedLaw:
        loop = LoopConfig(1.0 / world.frequency_hz, noisy=True)
        perceive = CameraPerception(camera, _load(self.model))
        return PerceivedLaw(self.controller, loop, perceive, world)


@lru_cache(maxsize=1)
def _load(model: str) -> FeatureModel:
    """The model, once a process: it drives many rounds."""
    return LocalModel(model)

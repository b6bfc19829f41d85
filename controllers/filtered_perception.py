"""Perception filtered over time by the car's own speeds and yaw rate (`--filter`)."""

from dataclasses import replace
from typing import TYPE_CHECKING

from controllers.perception import CameraPerception, Perceived, parse_prediction
from mtlnet.inference.track_filter import Measured, TrackFilter

if TYPE_CHECKING:
    from simulator.world.world import World


class FilteredPerception:
    """A camera's perception, whose offset, angle and curvature are those of a `TrackFilter`."""

    def __init__(self, perceive: CameraPerception) -> None:
        self._perceive = perceive
        self._filter = TrackFilter()

    def __call__(self, world: "World") -> Perceived:
        self._perceive(world)
        answer, now = self._perceive.answer, world.state
        perceived = parse_prediction(answer)
        self._filter.predict(1.0 / world.frequency_hz, now.vx, now.yaw_rate, now.vy)
        estimate = self._filter.update(Measured.of(answer))
        return replace(
            perceived,
            to_lane_centre=estimate.to_lane_centre,
            angle=estimate.angle,
            curvature=estimate.curvature,
        )

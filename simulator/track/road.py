"""The road along a track: its lanes, its asphalt and its edges. Metres, left positive."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.track.geometry import Track
from simulator.varied.carriageway import Carriageway
from trackfeatures.errors import UserError

START_BEFORE_LINE_M = 25.0
"""Distance (m) by which the start of a drive lies before the start line."""
SHOULDER_M = 1.0
"""Width (m) of the asphalt beyond the outermost marking."""
WALL_MARGIN_M = 2.5
"""Distance from the edge to the rails and walls. It exceeds half of a car's diagonal (2.46 m), so
that a car has left the track before any part of it touches a wall."""
BRIDGE_M = 3.0
"""A road is a bridge where it crosses a part of itself that is more than this (m) lower."""


@dataclass(frozen=True)
class Road:
    """`lanes` lanes of width `lane_width` (m), centred on `track`. A track narrower than the lanes
    and shoulders is widened.

    `carriageway` contains the lines and shoulders of a varied road; if it is None, the road has
    shoulders of 1 m, as in the paper, and one line per marking. Raises UserError unless the road
    has 1 to 3 lanes of 2.7 to 4.5 m, in agreement with the carriageway.
    """

    track: Track
    lanes: int = 1
    lane_width: float = tf.LANE_WIDTH_M
    carriageway: Carriageway | None = None

    def __post_init__(self) -> None:
        tf.check_lanes(self.lanes, self.lane_width)
        given = self.carriageway
        if given and (given.lane_width_m, len(given.markings)) != (self.lane_width, self.lanes + 1):
            raise UserError(
                f"a road of {self.lanes} lanes of {self.lane_width:g} m has a carriageway of "
                f"{len(given.markings) - 1} lanes of {given.lane_width_m:g} m; give its own"
            )

    @staticmethod
    def varied(track: Track, carriageway: Carriageway) -> "Road":
        """Return the road of a carriageway on `track`."""
        lanes = len(carriageway.markings) - 1
        return Road(track, lanes, carriageway.lane_width_m, carriageway)

    @property
    def half_width(self) -> float:
        """Half of the track's own width, which scales the offset in the reward and in the state
        vector. It is at most `edge`."""
        return self.track.width / 2

    @property
    def asphalt(self) -> tuple[float, float]:
        """Distances from the centre to the left and to the right end of the asphalt, both
        positive."""
        half = self.lanes * self.lane_width / 2
        left, right = self.carriageway.shoulders_m if self.carriageway else (SHOULDER_M,) * 2
        return half + left, half + right

    @property
    def half_asphalt(self) -> float:
        """Distance from the centre to the end of the asphalt, on the side where it is wider."""
        return max(self.asphalt)

    @property
    def edge(self) -> float:
        """Distance from the centre to the edge. A car whose centre of gravity is farther out is off
        the track; range beams end at the edge."""
        return max(self.half_width, self.half_asphalt)

    @property
    def wall_offset(self) -> float:
        """Distance from the centre to the rails and walls."""
        return self.edge + WALL_MARGIN_M

    @property
    def markings_y(self) -> NDArray[np.float64]:
        """Lateral positions (lanes + 1,) of the markings, from the leftmost to the rightmost."""
        return tf.marking_offsets(self.lanes, self.lane_width)

    def lines_y(self, to_middle: float) -> NDArray[np.float64]:
        """Return the lateral positions (lanes + 1,) of the lines that bound the lanes of a car at
        `to_middle`. For a double line this is the line nearer to the car's lane."""
        if not self.line_offsets:
            return self.markings_y
        lane = tf.lane_index(to_middle, self.lanes, self.lane_width)
        right_of = np.arange(self.lanes + 1) > lane
        offsets = np.array(self.line_offsets)
        return self.markings_y + np.where(right_of, offsets[:, 0], offsets[:, 1])

    def measure(self, s: float, to_middle: float, angle: float) -> tf.TrackFeatures:
        """Return the true track features of a car at (s, to_middle) m with `angle` in rad."""
        curvature = self.track.curvature(s)
        ahead = self.track.curvature(s + tf.LOOK_AHEAD_M)
        return tf.measure(
            to_middle, angle, curvature, ahead, self.lanes, self.lane_width, self.line_offsets
        )

    @property
    def line_offsets(self) -> tuple[tuple[float, float], ...]:
        """For each marking, the offsets (m, left positive) from its position to the line that
        bounds the lane to its left and to the line that bounds the lane to its right. Empty if the
        road is not varied (it has no carriageway)."""
        if self.carriageway is None:
            return ()
        return tuple((marking.left_m, marking.right_m) for marking in self.carriageway.markings)

"""The road laid on a track: lanes, asphalt and where it ends. Metres, left positive."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.track.geometry import Track

START_BEFORE_LINE_M = 25.0
"""A drive starts this far before the line."""
SHOULDER_M = 1.0
"""Asphalt beyond the outermost marking."""
WALL_MARGIN_M = 2.5
"""Rails and walls stand this far outside the edge: half a car's diagonal (2.46 m), so that a car
has left the track before any part of it meets a wall."""


@dataclass(frozen=True)
class Road:
    """`lanes` lanes of `lane_width`, centred on `track`; a track too narrow is widened.

    Raises UserError for a number or width of lanes outside the definitions.
    """

    track: Track
    lanes: int = 1
    lane_width: float = tf.LANE_WIDTH_M

    def __post_init__(self) -> None:
        tf.check_lanes(self.lanes, self.lane_width)

    @property
    def half_width(self) -> float:
        """`w`: half of the track's own width; scales reward and state, and is the least `edge`."""
        return self.track.width / 2

    @property
    def half_asphalt(self) -> float:
        """From the centre to the end of the asphalt."""
        return self.lanes * self.lane_width / 2 + SHOULDER_M

    @property
    def edge(self) -> float:
        """Farther from the centre than this is off the track; the range beams measure to it."""
        return max(self.half_width, self.half_asphalt)

    @property
    def wall_offset(self) -> float:
        """From the centre to the rails and walls."""
        return self.edge + WALL_MARGIN_M

    @property
    def markings_y(self) -> NDArray[np.float64]:
        """Lateral places (lanes + 1,) of the markings, from the leftmost to the rightmost."""
        return tf.marking_offsets(self.lanes, self.lane_width)

    def measure(self, s: float, to_middle: float, angle: float) -> tf.TrackFeatures:
        """True track features of a car at (s, to_middle) with heading angle `angle` (rad)."""
        curvature = self.track.curvature(s)
        ahead = self.track.curvature(s + tf.LOOK_AHEAD_M)
        return tf.measure(to_middle, angle, curvature, ahead, self.lanes, self.lane_width)

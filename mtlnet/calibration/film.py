"""Estimates a camera's mount (height and angles) from the consecutive pictures of a film or stream.

calibration = DriveCalibration(lens)
for picture, time_s in pictures:
    calibration.add(picture, time_s)
found = calibration.estimate()      # at any time; raises NotCalibrated
"""

from collections import deque
from dataclasses import dataclass, replace
from math import degrees, hypot
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.calibration.lens import KnownLens
from mtlnet.calibration.markings import Segments, find_segments
from mtlnet.calibration.motion import find_motion, follow
from mtlnet.calibration.mount import Mount, NotCalibrated, Sample, TimedMotion, find_mount
from mtlnet.calibration.road_fit import Lines
from mtlnet.calibration.vanishing_point import find_vanishing_point
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

LANE_WIDTH_M = 3.6
"""Lane width assumed if none is given, m."""
LANE_WIDTH_STD_M = 0.25
MAX_STD_DEG = 1.0
"""Maximum standard deviation of pitch and yaw, degrees, without the contribution of the lens. A
drive with a larger standard deviation is refused."""
LANE_WIDTHS_M = (2.0, 6.0)
SAMPLE_S = 0.2
"""Time between the pictures whose markings are used, s."""
FOLLOW_S = (0.09, 0.25)
"""Least and largest time between two pictures between which points are followed, s."""
KEPT = 600
"""Maximum number of pictures that are kept; for a stream these are the latest two minutes."""
FIRST_LOOK = 25
"""Number of pictures after which the horizon is first estimated; the expected width of markings in
the picture depends on it."""
WORKING_WIDTH = 640
TRACK_NOISE_PX = 0.2
MOTION_ROUNDS = 2


@dataclass(frozen=True)
class DriveEstimate:
    """The estimated camera, and the standard deviations of its mount in degrees and m."""

    camera: CameraParameters
    pitch_std_deg: float
    yaw_std_deg: float
    roll_std_deg: float
    height_std_m: float
    lens: KnownLens
    lane_width_m: float
    lane_width_given: bool
    pictures: int
    """Number of pictures that show the lane's markings on straight road."""

    def about(self) -> str:
        """Return the estimate as one line of text."""
        camera = self.camera
        assumed = "given" if self.lane_width_given else "assumed"
        return (
            f"pitch {camera.pitch_deg:.2f} +- {self.pitch_std_deg:.2f} deg, "
            f"yaw {camera.yaw_deg:.2f} +- {self.yaw_std_deg:.2f} deg, "
            f"roll {camera.roll_deg:.2f} +- {self.roll_std_deg:.2f} deg, "
            f"height {camera.height_above_road_m:.2f} +- {self.height_std_m:.2f} m, from "
            f"{self.pictures} pictures (lane width {self.lane_width_m:g} m, {assumed}; "
            f"{self.lens.about})"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the estimate with its standard deviations as values for JSON."""
        camera = self.camera
        return {
            "pitch_deg": camera.pitch_deg,
            "yaw_deg": camera.yaw_deg,
            "roll_deg": camera.roll_deg,
            "height_m": camera.height_above_road_m,
            "std": {
                "pitch_deg": self.pitch_std_deg,
                "yaw_deg": self.yaw_std_deg,
                "roll_deg": self.roll_std_deg,
                "height_m": self.height_std_m,
            },
            "fov_y_deg": camera.fov_y_deg,
            "lens": self.lens.about,
            "lane_width_m": self.lane_width_m,
            "pictures": self.pictures,
        }


class DriveCalibration:
    """Collects pictures of a drive and estimates the mount of their camera.

    The position x, y of `lens` on the car is kept; height and angles are estimated. The lane is
    assumed to be 3.6 m wide if `lane_width_m` is None.
    """

    def __init__(self, lens: KnownLens, lane_width_m: float | None = None) -> None:
        check_lane_width(lane_width_m)
        self._lens = lens
        camera = lens.camera
        scale = min(1.0, WORKING_WIDTH / camera.width)
        self._view = camera.resized(round(camera.width * scale), round(camera.height * scale))
        self._lane_width_m = lane_width_m
        self._samples: deque[Sample] = deque(maxlen=KEPT)
        self._tracks: deque[tuple[float, float, NDArray[np.float64]]] = deque(maxlen=KEPT)
        self._before: tuple[float, NDArray[np.uint8]] | None = None
        self._next_s = -np.inf
        self._taken = 0
        self._horizon_px = float(self._view.intrinsics()[1, 2])

    @property
    def pictures(self) -> int:
        """Number of pictures whose markings are used for the estimate, at most the latest 600."""
        return len(self._samples)

    def add(self, picture: NDArray[np.uint8], time_s: float, *, bgr: bool = False) -> None:
        """Add a picture (H, W, 3), taken at `time_s` (s), of the lens's camera in any size with its
        aspect ratio; `bgr`: the channels are BGR, not RGB. Times must increase. Most pictures of a
        film are skipped: markings are found in a picture every 0.2 s (SAMPLE_S)."""
        if time_s >= self._next_s:
            self._next_s = max(self._next_s + SAMPLE_S, time_s + SAMPLE_S / 2)
            small = self._resized(picture, bgr)
            self._samples.append(Sample(time_s, self._lines(small)))
            self._taken += 1
            # Points are followed from every second of these pictures.
            self._before = (time_s, _grey(small)) if self._taken % 2 else None
            if self._taken == FIRST_LOOK:
                self._look()
        elif self._before is not None and time_s - self._before[0] >= FOLLOW_S[0]:
            begin, before = self._before
            self._before = None
            if time_s - begin <= FOLLOW_S[1]:
                tracks = follow(before, _grey(self._resized(picture, bgr)))
                if tracks is not None:
                    self._tracks.append((begin, time_s - begin, self._normalised_tracks(tracks)))

    def estimate(self) -> DriveEstimate:
        """Estimate the camera from the pictures added so far. Raises NotCalibrated if too few of
        them show a marked straight road, or if pitch or yaw is uncertain by more than 1 degree."""
        width = self._lane_width_m
        start = find_vanishing_point(sample.lines for sample in self._samples)
        if start is None:
            raise NotCalibrated(
                f"no markings of a road can be seen in {len(self._samples)} pictures; take a "
                "minute of driving on a marked road by day"
            )
        motions = self._motions(start)
        mount = find_mount(
            self._samples,
            motions,
            start,
            LANE_WIDTH_M if width is None else width,
            LANE_WIDTH_STD_M if width is None else 0.0,
        )
        spread = degrees(max(mount.pitch_std, mount.yaw_std))
        if not spread <= MAX_STD_DEG:
            raise NotCalibrated(
                f"its pictures disagree by {spread:.1f} deg on where the road leads; at most "
                f"{MAX_STD_DEG:g} is of use: take a minute of steady driving on a marked road"
            )
        return self._estimate(mount)

    def _motions(self, start: tuple[float, float]) -> list[TimedMotion]:
        """Return the camera's motions between followed pictures. The direction of travel of each
        motion is searched near `start`, the film's vanishing point (x, y) in normalised
        coordinates; in the second round, near the median direction of the first round."""
        noise, towards = TRACK_NOISE_PX / self._view.focal_px, np.array(start)
        motions: list[TimedMotion] = []
        for _ in range(MOTION_ROUNDS):
            found = [(t, dt, find_motion(tracks, towards, noise)) for t, dt, tracks in self._tracks]
            motions = [TimedMotion(t, dt, motion) for t, dt, motion in found if motion is not None]
            if motions:
                towards = np.median([each.motion.towards for each in motions], axis=0)
        return motions

    def _estimate(self, mount: Mount) -> DriveEstimate:
        """Return the estimate for a mount. The angles' standard deviations include the error of the
        focal length, which scales the angles."""
        lens, given = self._lens, self._lane_width_m is not None
        camera = replace(
            lens.camera,
            z=mount.height_m - lens.camera.cg_height_m,
            pitch_deg=degrees(mount.pitch),
            yaw_deg=degrees(mount.yaw),
            roll_deg=degrees(mount.roll),
            height_std=mount.height_std_m / mount.height_m,
        )
        return DriveEstimate(
            camera,
            hypot(degrees(mount.pitch_std), lens.std * camera.pitch_deg),
            hypot(degrees(mount.yaw_std), lens.std * camera.yaw_deg),
            degrees(mount.roll_std),
            mount.height_std_m,
            lens,
            self._lane_width_m or LANE_WIDTH_M,
            given,
            mount.pictures,
        )

    def _resized(self, picture: NDArray[np.uint8], bgr: bool) -> NDArray[np.uint8]:
        """Return the picture in RGB at the working size."""
        size = (self._view.width, self._view.height)
        if picture.shape[1::-1] != size:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        return picture[..., ::-1] if bgr else picture

    def _look(self) -> None:
        found = find_vanishing_point(sample.lines for sample in self._samples)
        if found is not None:
            k = self._view.intrinsics()
            self._horizon_px = float(k[1, 2] + k[1, 1] * found[1])

    def _lines(self, picture: NDArray[np.uint8]) -> Lines:
        """Find the markings' segments in a picture; returns them in normalised coordinates, without
        the lens's distortion."""
        return normalised(find_segments(picture, self._horizon_px), self._view)

    def _normalised_tracks(self, tracks: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = self._view.rays(tracks.reshape(-1, 2))[:, :2].reshape(-1, 4)
        return rays[np.isfinite(rays).all(axis=1)]


def check_lane_width(lane_width_m: float | None) -> None:
    """Raise UserError for a lane width outside 2 to 6 m; None is allowed."""
    low, high = LANE_WIDTHS_M
    if lane_width_m is not None and not low <= lane_width_m <= high:
        raise UserError(f"--lane-width {lane_width_m:g} m; give {low:g} to {high:g} m")


def normalised(segments: Segments, view: CameraParameters) -> Lines:
    """Convert segments from px of the camera `view` to normalised coordinates without lens
    distortion. Each segment becomes the straight line between its two converted ends."""
    half = 0.5 * segments.rows
    ends = [
        view.rays(
            np.column_stack([segments.u + sign * half * segments.slope, segments.v + sign * half])
        )
        for sign in (-1.0, 1.0)
    ]
    (x1, y1), (x2, y2) = ends[0][:, :2].T, ends[1][:, :2].T
    size = y2 - y1
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (x2 - x1) / size
    seen = np.isfinite(slope) & (size > 0)
    lines = Lines(0.5 * (x1 + x2), 0.5 * (y1 + y2), slope, segments.slope_std, size)
    return lines.chosen(seen)


def _grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY).astype(
        np.uint8, copy=False
    )

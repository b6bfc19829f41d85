"""Computes labels of the road ahead from recorded rounds, for the auxiliary heads in training
(`mtlnet.model.auxiliary`).

The columns are the positions, in px from the left edge of the image, at which the two markings of
the car's lane cross the ten image rows `ROWS`. They are computed from the polylines recorded with
every image, and are NaN outside the image. The curvatures, 1/m, positive to the left, are the
road's curvatures at the eight distances `AHEAD_M`, 0 to 40 m in front of the car. They are read
from the labels of all frames of the same track, and are NaN where no frame was recorded nearby.
"""

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import DatasetError, Frames
from datagen.recording.mcap.index import Messages, open_round
from datagen.recording.schema.polylines import CORNER_PX, read_polylines
from datagen.recording.schema.topics import ANNOTATIONS, CAMERA
from mtlnet.data.augment.geometric import (
    horizon_row,
    rotation_homography,
    rotations,
    shear_per_metre,
)
from mtlnet.data.augment.pipeline import AugmentParams
from mtlnet.data.loader import Images
from mtlnet.data.model_labels import camera_scales
from mtlnet.model.auxiliary import AHEAD_M, ROWS, SIDES
from trackfeatures.camera import CameraParameters

POINTS = 34
"""Number of points read from a polyline, which has one per metre and starts just behind the camera.
The farthest of `ROWS` shows the road 25 m ahead."""
NEAREST_M, APART_M = 12.0, 1.2
"""A polyline belongs to a marking of the lane only if its start is at most `NEAREST_M` in front of
the camera and at most `APART_M` to the side of the marking."""
CHUNK = 20_000  # frames per task of a reading process
KNOWN_M = 2.0
"""A curvature is known if a frame was recorded within this distance of the point."""

HARD_CURVATURE = 1 / 80  # 1/m; a frame with a larger curvature is hard
HARD_NEAR_CHANGE_M = 8.0
"""Distance to a change of class within which a frame is hard: 80 % of a model's wrong classes lay
within 8 m, 53 % within 4 m."""


class RoadAhead:
    """Labels of the road ahead for frames, after augmentation of their images.

    `keep`: read the polylines of all frames when this object is made, on all cores, and keep them
    in memory (0.5 kB per frame). Otherwise they are read for each batch.
    """

    def __init__(self, frames: Frames, camera: CameraParameters, *, keep: bool = False) -> None:
        self._camera = camera
        self._paths = [info.path for info in frames.rounds]
        self._lines: dict[int, Messages] = {}
        self._places = frames.places()
        self._beside = lane_beside(frames)
        self._kept = self._read_all() if keep else None
        labels = frames.labels
        tracks = np.array([info.track for info in frames.rounds])[labels.round]
        scale = camera_scales(frames)
        self._curvature = curvature_ahead(labels.s, labels.curvature, tracks, scale)

    def labels(
        self, indices: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """Return the 20 columns (px) and 8 curvatures (1/m) of the frames `indices` (B,), whose
        images were augmented with `params`, as one row per frame (B, 28)."""
        columns = self.columns(indices, params).reshape(len(indices), -1)
        return np.concatenate([columns, self.curvatures(indices, params)], 1)

    def columns(
        self, indices: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """Return the columns (B, 2, 10), px, of both markings in each of `ROWS`, for the frames
        `indices` (B,), whose images were augmented with `params`."""
        points = self._read(indices) if self._kept is None else self._kept[indices]
        if params is None:
            return crossings(points, self._camera.width)
        return crossings(changed_points(points, params, self._camera), self._camera.width)

    def _read(self, indices: NDArray[np.int64]) -> NDArray[np.float32]:
        """Read the polylines (B, 2, 34, 2), px, of both markings of the lane, NaN where there is
        none."""
        points = np.full((len(indices), SIDES, POINTS, 2), np.nan, np.float32)
        for row, i in enumerate(indices.tolist()):
            number, frame = self._places[i].tolist()
            if number not in self._lines:
                self._lines[number] = _annotations(self._paths[number])
            try:
                lines = read_polylines(self._lines[number].payload(frame))
            except ValueError as error:
                raise DatasetError(
                    f"{self._paths[number]}: the annotations of frame {frame} are damaged "
                    f"({error}); run `datagen verify` on the dataset and record the round again"
                ) from error
            own_markings(lines, self._beside[i], self._camera, points[row])
        return points

    def _read_all(self) -> NDArray[np.float32]:
        parts = np.array_split(np.arange(len(self._places)), max(len(self._places) // CHUNK, 1))
        with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
            return np.concatenate(list(pool.map(self._read, parts)))

    def curvatures(
        self, indices: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """Return the curvatures (B, 8), 1/m, at each of `AHEAD_M`, for the frames `indices` (B,),
        whose images were augmented with `params`."""
        found = self._curvature[indices]
        return found if params is None else np.where(params.mirrored[:, None], -found, found)


def _annotations(path: Path) -> Messages:
    """Read the annotations of a round's frames, in the order of the frames. Raises DatasetError
    unless each image has its annotation, or if a message index is damaged."""
    index = open_round(path, (CAMERA, ANNOTATIONS))
    found = index.messages
    if not np.array_equal(index.log_times(CAMERA), index.log_times(ANNOTATIONS)):
        raise DatasetError(
            f"{path.name}: its {len(found[CAMERA])} images do not pair with its "
            f"{len(found[ANNOTATIONS])} annotations; record the round again"
        )
    return found[ANNOTATIONS]


def lane_beside(frames: Frames) -> NDArray[np.float64]:
    """Return the distances (N, 2), m at the model's camera, negative to the left, to both markings
    of the lane that the car is in or nearest to, whether or not the features are present."""
    labels, rounds = frames.labels, frames.rounds
    width = np.array([info.lane_width_m for info in rounds])[labels.round]
    centre = width * (labels.lanes / 2 - labels.lane_index - 0.5)
    left = labels.to_middle - centre - width / 2
    return np.column_stack([left, left + width]) * camera_scales(frames)[:, None]


def own_markings(
    lines: Sequence[NDArray[np.float64]],
    beside: NDArray[np.float64],
    camera: CameraParameters,
    out: NDArray[np.floating[Any]],
) -> None:
    """Write the polylines (px) of the two markings of the car's lane, found in `lines`, to `out`
    (2, 34, 2), which has room for 34 points of each.

    `lines`: polylines (points, 2), px; `beside` (2,): distances to the two markings, m, negative to
    the left. A polyline is assigned to a marking by its near end, as if the road were level there.
    The assignment is unique, because lanes are at least 2.7 m wide, more than twice `APART_M`.
    """
    nearest = np.full(SIDES, APART_M)
    drawn = [line for line in lines if len(line)]
    ends = camera.road_points([line[0] for line in drawn])
    for line, (ahead, left) in zip(drawn, ends, strict=True):
        if not ahead - camera.x <= NEAREST_M:  # NaN: above the horizon
            continue
        side = int(np.abs(beside + left).argmin())
        off = abs(beside[side] + left)
        if off < nearest[side]:
            nearest[side] = off
            out[side] = np.nan
            out[side, : len(line)] = line[:POINTS]


def changed_points(
    points: NDArray[np.floating[Any]], params: AugmentParams, camera: CameraParameters
) -> NDArray[np.float64]:
    """Return the positions of `points` (B, 2, 34, 2), px, in the images augmented with `params`, in
    the same shape."""
    moved = points.astype(np.float64)
    below = np.maximum(moved[..., 1] - horizon_row(camera), 0.0)
    moved[..., 0] += params.shift[:, None, None] * shear_per_metre(camera) * below
    ways = _turned(camera)[params.rotation][:, None, None]
    u, v, scale = np.moveaxis(
        np.squeeze(ways @ np.concatenate([moved, np.ones_like(moved[..., :1])], -1)[..., None], -1),
        -1,
        0,
    )
    moved = np.stack([u / scale, v / scale], -1)
    flipped = moved[:, ::-1].copy()
    flipped[..., 0] = camera.width - 1 - flipped[..., 0]
    return np.where(params.mirrored[:, None, None, None], flipped, moved)


@lru_cache(maxsize=2)
def _turned(camera: CameraParameters) -> NDArray[np.float64]:
    """Return the homographies (64, 3, 3) of all rotations of the augmentation."""
    return np.stack([rotation_homography(camera, *turn) for turn in rotations().tolist()])


def crossings(points: NDArray[np.floating[Any]], width: int) -> NDArray[np.float32]:
    """Return the columns (B, 2, 10), px, where polylines (B, 2, points, 2) first cross the ten
    image rows `ROWS`.

    NaN where a polyline does not cross the row, or crosses it outside an image of `width` px.
    """
    u, v = points[..., 0] + CORNER_PX, points[..., 1] + CORNER_PX
    rows = np.array(ROWS)
    v0, v1 = v[..., :-1, None], v[..., 1:, None]
    # From its near end on, a line rises in the image; comparisons with NaN are false.
    across = (v0 >= rows) & (v1 < rows)
    first = across.argmax(2)  # (B, 2, ROWS)
    found = across.any(2)
    here = [np.take_along_axis(part, first + after, 2) for part in (u, v) for after in (0, 1)]
    u0, u1, v_0, v_1 = here
    with np.errstate(invalid="ignore", divide="ignore"):
        column = u0 + (u1 - u0) * (v_0 - rows) / (v_0 - v_1)
        found &= (column >= 0) & (column < width)
    return np.where(found, column, np.nan).astype(np.float32)


def curvature_ahead(
    s: NDArray[np.float32],
    curvature: NDArray[np.float32],
    tracks: NDArray[np.str_],
    scale: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the curvatures (N, 8), 1/m, of the road at the distances `AHEAD_M` in front of cars at
    `s` (N,) m on `tracks` (N,), where the road's curvature is `curvature` (N,).

    `scale` (N,): metres at the model's camera, in which the result is given, per metre of the car.
    A track is the same in all its rounds, so the frames of all rounds are used; NaN where no frame
    was recorded within 2 m.
    """
    found = np.full((len(s), len(AHEAD_M)), np.nan, np.float32)
    for track in np.unique(tracks).tolist():
        here = np.flatnonzero(tracks == track)
        order = here[np.argsort(s[here], kind="stable")]
        places = s[order]
        ahead = np.array(AHEAD_M, np.float32) / scale[here, None].astype(np.float32)
        wanted = s[here][:, None] + ahead
        after = np.searchsorted(places, wanted).clip(max=len(places) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(wanted - places[before] < places[after] - wanted, before, after)
        near = np.abs(places[nearest] - wanted) <= KNOWN_M
        found[here] = np.where(near, curvature[order][nearest], np.nan)
    return (found / scale[:, None]).astype(np.float32)


def hard_frames(
    s: NDArray[np.float32],
    curvature: NDArray[np.float32],
    heading: NDArray[np.int64],
    tracks: NDArray[np.str_],
) -> NDArray[np.bool_]:
    """Return a mask (N,) of the frames in bends with a radius under 80 m, or within 8 m of a point
    where the class of the road changes.

    Most errors of a network occur in these frames. `s` (N,) m, `curvature` (N,) 1/m and `heading`
    (N,) are the labels; the points where the class changes are found from all frames of a track.
    """
    found = np.abs(curvature) > HARD_CURVATURE
    for track in np.unique(tracks).tolist():
        here = np.flatnonzero(tracks == track)
        order = here[np.argsort(s[here], kind="stable")]
        places = s[order].astype(np.float64)
        changes = np.flatnonzero(np.diff(heading[order]))
        if len(changes):
            between = (places[changes] + places[changes + 1]) / 2
            after = np.searchsorted(between, s[here]).clip(max=len(between) - 1)
            before = np.maximum(after - 1, 0)
            away = np.minimum(np.abs(between[after] - s[here]), np.abs(between[before] - s[here]))
            found[here] |= away <= HARD_NEAR_CHANGE_M
    return found


def hard_frame_repeats(frames: Images, repeats: int) -> NDArray[np.int64] | None:
    """Return the number of times (N,) that each frame is used in an epoch: `repeats` for the hard
    frames of recorded rounds, 1 for other frames. None: every frame is used once."""
    if repeats == 1 or not isinstance(frames, Frames):
        return None
    labels = frames.labels
    tracks = np.array([info.track for info in frames.rounds])[labels.round]
    hard = hard_frames(labels.s, labels.curvature, labels.heading, tracks)
    return np.where(hard, repeats, 1)

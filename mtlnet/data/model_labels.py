"""Labels and answers of rounds whose camera is mounted elsewhere than the model's.

A picture does not show how high its camera is. The network answers as if every picture were of the
model's camera: what it is trained on are the distances that such a car would have beside such a
road. Its answers are turned back into metres of the car by `Rectification.outputs`.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from datagen.recording.labels import Labels
from datagen.recording.round_metadata import RoundInfo
from mtlnet.inference.rectification import Rectification
from trackfeatures.camera import CameraParameters
from trackfeatures.measurement import LineOffsets


def model_labels(frames: Frames) -> Labels:
    """The labels of `frames` as the network is to answer them, in metres beside `frames.camera`.

    The limits of the in-lane and the on-marking system are met there, not at the car: whether a
    distance is present follows from the picture as well.
    """
    labels = frames.labels
    distances = labels.distances.copy()
    for number, info in moved_rounds(frames):
        rows = np.flatnonzero(labels.round == number)
        distances[rows] = _beside(labels.take(rows), info, frames.camera)
    offset = tf.localise(distances).astype(np.float32)
    return replace(labels, distances=distances, to_lane_centre=offset)


def car_outputs(outputs: NDArray[np.float32], frames: Frames) -> NDArray[np.float32]:
    """A model's outputs (N, 9 to 22) for `frames` in metres of the cars that the rounds show."""
    changed, of_round = outputs.copy(), frames.labels.round
    for number, info in moved_rounds(frames):
        rows = np.flatnonzero(of_round == number)
        changed[rows] = round_rectification(info, frames.camera).outputs(outputs[rows])
    return changed


def moved_rounds(frames: Frames) -> list[tuple[int, RoundInfo]]:
    """Number and description of the rounds whose camera is mounted elsewhere."""
    rounds = enumerate(frames.rounds)
    return [(n, info) for n, info in rounds if not _as_mounted(info.label_camera, frames.camera)]


def round_rectification(info: RoundInfo, camera: CameraParameters) -> Rectification:
    """Between the camera that a round's labels were measured with and `camera`, the model's."""
    return Rectification(info.label_camera, camera, any_height=True)


def camera_scales(frames: Frames) -> NDArray[np.float64]:
    """Metres beside the model's camera per metre of the car, of each of `frames` (N,)."""
    rounds = (round_rectification(info, frames.camera) for info in frames.rounds)
    return np.array([1 / each.scale for each in rounds])[frames.labels.round]


def _as_mounted(camera: CameraParameters, other: CameraParameters) -> bool:
    return (camera.x, camera.y, camera.z) == (other.x, other.y, other.z)


def _beside(labels: Labels, info: RoundInfo, camera: CameraParameters) -> NDArray[np.float32]:
    """Distances (N, 5) of a round's frames beside `camera`, NaN where absent there."""
    rectification = round_rectification(info, camera)
    scale = 1 / rectification.scale
    # Distances are measured at the centre of gravity, not at the camera.
    beside = np.zeros((len(labels), len(tf.MARKINGS)), np.float32)
    shift = rectification.labels(beside, labels.angle)[:, 0]
    place = labels.to_middle + _foot(labels, info)
    offsets = [(left * scale, right * scale) for left, right in info.line_offsets]
    return _measured(place * scale + shift, info.lanes, info.lane_width_m * scale, offsets)


def _foot(labels: Labels, info: RoundInfo) -> NDArray[np.float64]:
    """How far left of the recorded offset (N,) distances were measured: on a banked road, at the
    foot of the centre of gravity."""
    level = labels.to_middle.astype(np.float64)
    expected = _measured(level, info.lanes, info.lane_width_m, info.line_offsets)
    gaps = labels.distances - expected
    known = ~np.isnan(gaps).all(1)
    foot = np.zeros(len(labels))
    foot[known] = np.nanmedian(gaps[known], axis=1)
    return foot


def _measured(
    to_middle: NDArray[np.float64], lanes: int, lane_width_m: float, offsets: LineOffsets
) -> NDArray[np.float32]:
    """The distances (N, 5) at offsets (N,) from the middle of a road, NaN where absent."""
    found = (tf.measure(y, 0.0, 0.0, 0.0, lanes, lane_width_m, offsets) for y in to_middle.tolist())
    rows = [[np.nan if d is None else d for d in each.distances.values()] for each in found]
    return np.array(rows, np.float32).reshape(-1, len(tf.MARKINGS))

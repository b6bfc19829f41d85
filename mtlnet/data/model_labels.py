"""Converts labels and outputs of rounds whose camera is mounted at another position than the
model's camera.

A picture does not show the height of its camera, so the network answers as if every picture were
taken by the model's camera. Therefore the network is trained on the distances that a car with the
model's camera would have on a road that looks the same. `Rectification.outputs` converts the
answers back to metres of the actual car.
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
    """Return the labels of `frames` in metres at the model's camera, `frames.camera`. They are the
    targets of the network.

    The limits of the in-lane and the on-marking system are applied to these converted distances, so
    that the presence of a distance also follows from the picture alone.
    """
    labels = frames.labels
    distances = labels.distances.copy()
    for number, info in moved_rounds(frames):
        rows = np.flatnonzero(labels.round == number)
        distances[rows] = _beside(labels.take(rows), info, frames.camera)
    offset = tf.localise(distances).astype(np.float32)
    return replace(labels, distances=distances, to_lane_centre=offset)


def car_outputs(outputs: NDArray[np.float32], frames: Frames) -> NDArray[np.float32]:
    """Return a model's outputs (N, K) for `frames`, converted to metres of the recorded cars.

    `mtlnet.inference.prediction.split_outputs` explains the K columns.
    """
    changed, of_round = outputs.copy(), frames.labels.round
    for number, info in moved_rounds(frames):
        rows = np.flatnonzero(of_round == number)
        changed[rows] = round_rectification(info, frames.camera).outputs(outputs[rows])
    return changed


def moved_rounds(frames: Frames) -> list[tuple[int, RoundInfo]]:
    """Return index and description of each round whose camera is mounted at another position than
    the model's camera, `frames.camera`."""
    rounds = enumerate(frames.rounds)
    return [(n, info) for n, info in rounds if not _as_mounted(info.label_camera, frames.camera)]


def round_rectification(info: RoundInfo, camera: CameraParameters) -> Rectification:
    """Return the rectification from the camera with which the round `info` was labelled to the
    model's `camera`."""
    return Rectification(info.label_camera, camera, any_height=True)


def camera_scales(frames: Frames) -> NDArray[np.float64]:
    """Return, for each of N frames, the metres at the model's camera per metre of the recorded car
    (N,)."""
    rounds = (round_rectification(info, frames.camera) for info in frames.rounds)
    return np.array([1 / each.scale for each in rounds])[frames.labels.round]


def _as_mounted(camera: CameraParameters, other: CameraParameters) -> bool:
    return (camera.x, camera.y, camera.z) == (other.x, other.y, other.z)


def _beside(labels: Labels, info: RoundInfo, camera: CameraParameters) -> NDArray[np.float32]:
    """Return the distances (N, 5) of a round's frames, m at the model's `camera`, NaN where
    absent."""
    rectification = round_rectification(info, camera)
    scale = 1 / rectification.scale
    # Distances are measured at the centre of gravity, not at the camera.
    beside = np.zeros((len(labels), len(tf.MARKINGS)), np.float32)
    shift = rectification.labels(beside, labels.angle)[:, 0]
    place = labels.to_middle + _foot(labels, info)
    offsets = [(left * scale, right * scale) for left, right in info.line_offsets]
    return _measured(place * scale + shift, info.lanes, info.lane_width_m * scale, offsets)


def _foot(labels: Labels, info: RoundInfo) -> NDArray[np.float64]:
    """Return the offsets (N,), m to the left, from the recorded position to the point at which the
    distances were measured. On a banked road this point is the foot of the centre of gravity."""
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
    """Return the distances (N, 5), m, NaN where absent, of cars at offsets `to_middle` (N,), m to
    the left, from the middle of a road."""
    found = (tf.measure(y, 0.0, 0.0, 0.0, lanes, lane_width_m, offsets) for y in to_middle.tolist())
    rows = [[np.nan if d is None else d for d in each.distances.values()] for each in found]
    return np.array(rows, np.float32).reshape(-1, len(tf.MARKINGS))

"""Defines the features of a LeRobot export and makes their columns for its parquet files.

Source: LeRobotDataset v3.0, github.com/huggingface/lerobot. Vectors are float32; an absent distance
is NaN, because LeRobot's tensors hold no nulls. Units and signs are the same as in the recording.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.export.webdataset import SUFFIX
from datagen.view.steps import Step, values
from trackfeatures.camera import CameraParameters

IMAGE = "observation.images.front"
STATE = ("vx", "vy", "yaw_rate")
POSE = ("x", "y", "z", "yaw", "pitch", "roll")
ACTION = ("steer", "throttle", "brake", "gear")
LABELS = (
    *(f"to_marking_{name}" for name in tf.MARKINGS),
    "to_lane_centre", "angle", "heading", "lanes", "lane_index", "curvature", "to_middle", "s",
)  # fmt: skip
VECTORS = {
    "observation.state": STATE,
    "action": ACTION,
    "labels": LABELS,
    "pose": POSE,
    "shadow_fraction": ("shadow_fraction",),
}
COUNTERS = ("frame_index", "episode_index", "index", "task_index")

Columns = dict[str, NDArray[Any]]


def features(camera: CameraParameters) -> dict[str, Any]:
    """Return the value of `features` in meta/info.json: type, shape and names of each column."""
    image = {
        "dtype": "image",
        "shape": [camera.height, camera.width, 3],
        "names": ["height", "width", "channels"],
    }
    vectors = {
        name: {"dtype": "float32", "shape": [len(parts)], "names": list(parts)}
        for name, parts in VECTORS.items()
    }
    scalar = {"shape": [1], "names": None}
    time = {"timestamp": {"dtype": "float32", **scalar}}
    counters = {name: {"dtype": "int64", **scalar} for name in COUNTERS}
    return {IMAGE: image, **vectors, **time, **counters}


def columns(steps: Sequence[Step], fps: int, episode: int, first: int, task: int) -> Columns:
    """Return the columns of an episode by name, one row for each of its frames `steps`, without the
    images.

    `fps` is the number of frames per second, from which the timestamps (s) are computed. `episode`
    is the index of the episode, and `first` the index of the episode's first frame in the dataset.
    `task` is the index of its task (the trajectory) in meta/tasks.parquet.
    """
    rows = [_row(step) for step in steps]
    found: Columns = {
        name: np.array([[row[part] for part in parts] for row in rows], np.float32)
        for name, parts in VECTORS.items()
    }
    frame = np.arange(len(steps), dtype=np.int64)
    found["timestamp"] = (frame / fps).astype(np.float32)
    found["frame_index"], found["index"] = frame, frame + first
    found["episode_index"] = np.full_like(frame, episode)
    found["task_index"] = np.full_like(frame, task)
    return found


def _row(step: Step) -> dict[str, Any]:
    """Return the values of the frame `step` by name. Absent values are None; `columns` stores them
    as NaN."""
    row = values(step.labels) | values(step.ego) | values(step.command)
    return row | {"heading": step.labels.heading}


def table(steps: Sequence[Step], numbers: Columns, codec: str) -> pa.Table:
    """Return the rows of an episode as a table for the files in data/: the columns `numbers`, and
    the encoded images of the frames `steps`. `codec` ("jpeg" or "png") sets the suffix of the image
    names."""
    images = pa.StructArray.from_arrays(
        [
            pa.array([bytes(step.image) for step in steps], pa.binary()),
            pa.array([f"frame-{step.number:06d}.{SUFFIX[codec]}" for step in steps], pa.string()),
        ],
        names=["bytes", "path"],
    )
    arrays = {IMAGE: images} | {name: _array(column) for name, column in numbers.items()}
    return pa.table(arrays).replace_schema_metadata({"huggingface": _hugging_face()})


def _array(column: NDArray[Any]) -> pa.Array:
    if column.ndim == 1:
        return pa.array(column)
    if column.shape[1] == 1:  # LeRobot stores vectors of length 1 as numbers
        return pa.array(column[:, 0])
    return pa.FixedSizeListArray.from_arrays(pa.array(column.ravel()), column.shape[1])


def _hugging_face() -> str:
    """Metadata (JSON) with the types of all columns; the library `datasets` needs it to decode the
    image column."""
    types: dict[str, Any] = {IMAGE: {"_type": "Image"}}
    for name, parts in VECTORS.items():
        number = {"dtype": "float32", "_type": "Value"}
        types[name] = (
            number
            if len(parts) == 1
            else {"feature": number, "length": len(parts), "_type": "Sequence"}
        )
    types["timestamp"] = {"dtype": "float32", "_type": "Value"}
    types |= {name: {"dtype": "int64", "_type": "Value"} for name in COUNTERS}
    return json.dumps({"info": {"features": types}})

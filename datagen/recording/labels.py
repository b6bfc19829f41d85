"""Reads the labels of many frames as arrays, in the track frame and units of `trackfeatures`."""

from dataclasses import dataclass, fields

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from datagen.recording.errors import DatasetError
from datagen.recording.mcap.index import RoundIndex
from datagen.recording.schema.proto.driverview_pb2 import TrackFeatures, VehicleState
from datagen.recording.schema.topics import CAMERA, EGO_STATE, LABELS, steps_at

NAN = float("nan")
LABEL_VALUES, MOTION_VALUES = 13, 2  # lengths of the tuples of `_label_row` and `_motion_row`


@dataclass(frozen=True)
class Labels:
    """Labels of N frames; `distances` are ml, mr, l, m, r in m, NaN where absent."""

    distances: NDArray[np.float32]  # (N, 5)
    angle: NDArray[np.float32]  # (N,), as all arrays below; rad
    heading: NDArray[np.int64]  # 0 left, 1 straight, 2 right
    lanes: NDArray[np.int64]  # number of lanes of the road
    lane_index: NDArray[np.int64]  # 0 leftmost
    curvature: NDArray[np.float32]  # 1/m
    to_lane_centre: NDArray[np.float32]  # m, NaN where absent
    to_middle: NDArray[np.float32]  # m
    s: NDArray[np.float32]  # m along the centre line
    speed: NDArray[np.float32]  # m/s along the body
    shadow_fraction: NDArray[np.float32]  # share of the road within 30 m ahead in shadow
    light: NDArray[np.str_]  # name of the light
    round: NDArray[np.int64]  # index into the rounds of these frames

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, indices: NDArray[np.int64]) -> "Labels":
        return Labels(**{f.name: getattr(self, f.name)[indices] for f in fields(self)})


def read_labels(
    index: RoundIndex, round_number: int, frames: NDArray[np.int64] | None = None
) -> Labels:
    """Read the labels of the frames `frames` (N,) of the opened round `index`; None: of all frames.

    `round_number` is the value of the column `round`. Raises DatasetError if an image has no label
    or state, or a label of `frames` is damaged.
    """
    camera, labels, states = (index.messages[t] for t in (CAMERA, LABELS, EGO_STATE))
    count = len(camera)
    chosen = range(count) if frames is None else frames.tolist()
    try:
        for name, other in (("labels", labels), ("ego states", states)):
            if not np.array_equal(camera.log_time, other.log_time):
                raise DatasetError(
                    f"{index.path.name}: {count} images do not pair with its {len(other)} {name}; "
                    "run `datagen verify` on the dataset and record the round again"
                )
        rows = np.array([_label_row(labels.payload(i)) for i in chosen], np.float64)
        motion = np.array([_motion_row(states.payload(i)) for i in chosen], np.float64)
    except (DecodeError, ValueError) as error:
        raise DatasetError(
            f"{index.path.name}: a label is damaged ({error}); run `datagen verify` on the "
            "dataset, and record the round again or save its undamaged frames with "
            "`datagen recover`"
        ) from error
    if not count:
        raise DatasetError(f"{index.path.name} has no frames; record the round again")
    rows, motion = rows.reshape(-1, LABEL_VALUES), motion.reshape(-1, MOTION_VALUES)
    light = light_per_frame(index)
    return Labels(
        distances=_to_float32(rows[:, :5]),
        to_lane_centre=_to_float32(rows[:, 5]),
        angle=_to_float32(rows[:, 6]),
        heading=rows[:, 7].astype(np.int64),
        lanes=rows[:, 8].astype(np.int64),
        lane_index=rows[:, 9].astype(np.int64),
        curvature=_to_float32(rows[:, 10]),
        to_middle=_to_float32(rows[:, 11]),
        s=_to_float32(rows[:, 12]),
        speed=_to_float32(motion[:, 0]),
        shadow_fraction=_to_float32(motion[:, 1]),
        light=light if frames is None else light[frames],
        round=np.full(len(chosen), round_number, dtype=np.int64),
    )


def light_per_frame(index: RoundIndex) -> NDArray[np.str_]:
    """Return the name of the light (N,) at each frame of the opened round `index`. It is computed
    from the log times, because frames of a recovered round can be missing."""
    header = index.header
    frames = steps_at(index.messages[CAMERA].log_time, header.frequency_hz)
    stretch = header.stretch or int(frames.max(initial=0)) + 1
    lights: NDArray[np.str_] = np.array(header.lights)[frames // stretch % len(header.lights)]
    return lights


def concatenate(parts: list[Labels]) -> Labels:
    """Join the labels in `parts`, in their order."""
    return Labels(
        **{
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(Labels)
        }
    )


def _to_float32(values: NDArray[np.float64]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # only a damaged label exceeds the range of float32
        return values.astype(np.float32)


def _label_row(payload: memoryview) -> tuple[float, ...]:
    m = TrackFeatures.FromString(bytes(payload))
    has = m.HasField
    return (
        m.to_marking_ml if has("to_marking_ml") else NAN,
        m.to_marking_mr if has("to_marking_mr") else NAN,
        m.to_marking_l if has("to_marking_l") else NAN,
        m.to_marking_m if has("to_marking_m") else NAN,
        m.to_marking_r if has("to_marking_r") else NAN,
        m.to_lane_centre if has("to_lane_centre") else NAN,
        m.angle,
        m.heading,
        m.lanes,
        m.lane_index,
        m.curvature,
        m.to_middle,
        m.s,
    )


def _motion_row(payload: memoryview) -> tuple[float, float]:
    state = VehicleState.FromString(bytes(payload))
    return state.vx, state.shadow_fraction

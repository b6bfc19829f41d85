"""Evaluates a model as the paper does (Li et al., section VII), on rounds of `datagen protocol`:
`mtlnet evaluate --protocol paper --data datasets/protocol`.

The errors are mean absolute errors, in m and rad, of the offset from the middle of the one-lane
road and of the yaw angle, on whole drives and in four intervals of heavy shadow. The class is
evaluated on held-out rounds of nine tracks, whose full report (`mtlnet.evaluation.metrics`) is
included.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames, Labels
from datagen.recording.names import MIDDLE, UNSEEN
from mtlnet.evaluation.evaluate import about, predict_rounds, require_fit
from mtlnet.evaluation.metrics import evaluate_by_groups, signed_errors
from mtlnet.inference.engine import Engine
from mtlnet.inference.prediction import FEATURES, OUTPUTS
from trackfeatures.errors import UserError
from trackfeatures.road_class import UNKNOWN_HEADING

PAPER = "paper"
INTERVALS = 4
INTERVAL_FRAMES = 200
"""Number of frames of an interval: 10 s at 20 Hz. The paper marks four intervals of heavy shadow on
its lap but does not state their lengths. Here the whole lap is in shadow, so the intervals are its
darkest parts."""
FOUR = "four darkest intervals"
DRIVES = {
    ("g-track-3", "heavy-shadow"): "g-track-3, heavy shadow",
    ("g-track-3", "clear"): "g-track-3, clear",
    ("dirt-3", "clear"): "dirt-3, clear",
    ("dirt-3", "heavy-shadow"): "dirt-3, heavy shadow",
}
SHADED = DRIVES["g-track-3", "heavy-shadow"]
STATED: dict[str, dict[str, float]] = {
    f"{SHADED}: {FOUR}": {"distance_m": 0.071, "angle_rad": 0.003},
    DRIVES["dirt-3", "clear"]: {"distance_m": 0.107, "angle_rad": 0.004},
    "nine tracks, held-out rounds": {"heading_accuracy": 0.9878},
}
"""The results that the paper states: on g-track-3 and dirt-3 in its text, the accuracy on nine
tracks (MTL 3) in its table II."""

Rows = NDArray[np.int64]


def evaluate_protocol(
    engines: Sequence[Engine],
    data: Path,
    protocol: str,
    report: Callable[[int, int], None] = lambda *_: None,
    every: int = 1,
) -> dict[str, Any]:
    """Evaluate a model by the paper's protocol; returns the report on the held-out rounds, whose
    entry `protocol` has the rows of the paper's table.

    A row is for a drive (one of `DRIVES`), a part of a drive, or all rounds that are not in
    `DRIVES`. Its entry `paper` has the paper's figures. `protocol`: must be "paper". `every`:
    evaluate every n-th frame only. `report(done, total)` is called with numbers of frames. Raises
    UserError for another protocol and for data without the rounds of the protocol, ModelError for a
    model that was trained on these rounds or on dirt-3.
    """
    if protocol != PAPER:
        raise UserError(f"there is no protocol {protocol!r}; give {PAPER}")
    if every < 1:
        raise UserError(f"--every is {every}; give 1 for all frames, 5 for every fifth")
    dataset = Dataset.open(data)
    frames = dataset.select().every(every)
    rows = drive_rows(frames, data)
    card = engines[0].card
    for side in ("test", UNSEEN):
        require_fit(card, dataset.select(side), side)
    outputs = predict_rounds(engines, frames, data, report)
    driven = np.concatenate([*rows.values()])
    found = evaluate_by_groups(
        np.delete(outputs, driven, axis=0), frames.without(driven), card.data["mean"]
    )
    return {
        **about(engines[0]),
        "data": str(data),
        "split": "held-out",
        "every": every,
        "rounds": len(frames.rounds) - len(rows),
        **found,
        "protocol": protocol_rows(outputs, frames.labels, rows, every, found),
    }


def drive_rows(frames: Frames, data: Path) -> dict[str, Rows]:
    """Return, by the names of `DRIVES`, the indices of the frames of each drive, in order.

    Raises UserError if a drive is missing, if all rounds are drives, or if `frames` lacks all
    frames of a drive or of all other rounds.
    """
    labels = frames.labels
    found: dict[str, Rows] = {}
    for (track, light), name in DRIVES.items():
        rounds = [
            number
            for number, info in enumerate(frames.rounds)
            if (info.trajectory, info.track, info.light) == (MIDDLE, track, light)
        ]
        if len(rounds) != 1:
            raise UserError(
                f"{data} holds {len(rounds)} drives in the middle of {name}, one is expected; "
                "record it with `datagen protocol --out DIR`"
            )
        found[name] = np.flatnonzero(labels.round == rounds[0])
    if len(frames.rounds) == len(DRIVES):
        raise UserError(
            f"{data} holds drives but no rounds of the nine tracks; record it with "
            "`datagen protocol --out DIR`"
        )
    counts = {name: len(rows) for name, rows in found.items()}
    counts["the nine tracks"] = len(frames) - sum(counts.values())
    for name, count in counts.items():
        if not count:
            raise UserError(f"--every leaves no frame of {name}; give a smaller number")
    return found


def protocol_rows(
    outputs: NDArray[np.float32],
    labels: Labels,
    rows: dict[str, Rows],
    every: int,
    held_out: dict[str, Any],
) -> dict[str, dict[str, Any]]:
    """Return the rows of the table by name: drives, four intervals of heavy shadow, held-out rounds
    of nine tracks.

    `outputs` (N, K; columns: `split_outputs`); `rows`: the result of `drive_rows`; `every`: n if
    the frames are every n-th frame of the rounds; `held_out`: the report on the rounds that are not
    in `DRIVES`.
    """
    shaded = rows[SHADED]
    window = max(1, INTERVAL_FRAMES // every)
    intervals = darkest_intervals(labels.shadow_fraction[shaded], window)
    parts = {f"{SHADED}: {FOUR}": shaded[np.concatenate(intervals)], **rows}
    table = {name: drive_figures(outputs[part], labels.take(part)) for name, part in parts.items()}
    table[f"{SHADED}: {FOUR}"]["intervals"] = [
        {
            "s_m": [float(labels.s[shaded[i]]) for i in (each[0], each[-1])],
            **drive_figures(outputs[shaded[each]], labels.take(shaded[each])),
        }
        for each in intervals
    ]
    table["nine tracks, held-out rounds"] = {
        "frames": held_out["frames"],
        "distance_m": held_out["to_lane_centre_mae_m"],
        "angle_rad": held_out["angle_mae_rad"],
        "heading_accuracy": held_out["heading_accuracy"],
    }
    return {name: {**part, "paper": STATED.get(name, {})} for name, part in table.items()}


def darkest_intervals(shadow: NDArray[np.float32], window: int) -> list[Rows]:
    """Return up to four disjoint intervals of `window` frames with the largest mean shadow, each as
    an array of frame indices (window,), in the order of the frames.

    `shadow` (N,): share of the road in shadow. The darkest interval is chosen first, then the
    darkest interval that does not overlap it, and so on. If N is too small for four intervals of
    `window` frames, the intervals are shorter.
    """
    window = max(1, min(window, len(shadow) // (2 * INTERVALS - 1)))
    sums = np.convolve(shadow.astype(np.float64), np.ones(window), mode="valid")
    starts: list[int] = []
    while len(starts) < INTERVALS and np.isfinite(sums.max()):
        start = int(sums.argmax())
        starts.append(start)
        sums[max(0, start - window + 1) : start + window] = -np.inf
    return [np.arange(start, start + window) for start in sorted(starts)]


def drive_figures(outputs: NDArray[np.float32], labels: Labels) -> dict[str, Any]:
    """Return the results of a drive or of a part of a drive.

    `distance_m`, `angle_rad`: mean absolute errors of the offset from the lane centre and of the
    angle; `largest_...`: the largest errors; `zero_...`: the mean absolute errors of always
    answering zero; `absent`: number of frames without an answered offset, which have no error;
    `heading_accuracy`: share of correct classes.
    """
    errors = np.abs(signed_errors(outputs, labels.distances, labels.angle))
    distance, angle = (errors[:, FEATURES.index(f)] for f in ("to_lane_centre", "angle"))
    answered = distance[~np.isnan(distance)]
    known = labels.heading != UNKNOWN_HEADING
    right = (outputs[:, 6:OUTPUTS].argmax(1) == labels.heading)[known]
    return {
        "frames": len(labels),
        "absent": len(distance) - len(answered),
        "distance_m": float(answered.mean()) if len(answered) else None,
        "largest_distance_m": float(answered.max()) if len(answered) else None,
        "zero_distance_m": float(np.nanmean(np.abs(labels.to_lane_centre))),
        "angle_rad": float(angle.mean()),
        "largest_angle_rad": float(angle.max()),
        "zero_angle_rad": float(np.abs(labels.angle).mean()),
        "heading_accuracy": float(right.mean()) if len(right) else None,
    }

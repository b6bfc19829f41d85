"""Quantises a graph to int8 (by NNCF), and judges it by the accuracy gate, which limits the
increase of each error over float32 on the test rounds (`LIMITS`).

The weights of all convolutions and of all shared layers except the last are quantised. The
activations of most convolutions are quantised too, calibrated on training frames. Greedy forward
selection chooses the convolutions that keep float activations, until the errors grow by at most
half the gate's limits on train rounds that were held out of the training. (If the export uses a
dataset without these held-out rounds, a twelfth of its train rounds is used instead.) Nothing is
chosen on the test rounds. The fully connected layers are memory-bound. The last fully connected
layer before the heads is small but loses as much accuracy in int8 as the other two together, so it
stays in float.
"""

import logging
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Frames
from mtlnet.data.model_labels import model_labels
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.evaluation.metrics import evaluate_outputs
from mtlnet.inference.engine import load_engine, run_graph
from runtime.processor import has_int8

CALIBRATION_FRAMES = 300
FLOAT_ACTIVATIONS: tuple[int, ...] = (0, 2)
"""Default numbers, from 0, of the convolutions with float activations. In the paper's network,
quantising the activations of the first convolution costs more distance accuracy than quantising the
activations of all other convolutions together. Quantising the activations of the third convolution
costs more angle accuracy than all other convolutions together."""
MAX_FLOAT_ACTIVATIONS, MAX_CONVOLUTIONS = 3, 16
"""Maximum number of convolutions with float activations; maximum number of convolutions of a
network for which they are searched. A network with more convolutions gets `FLOAT_ACTIVATIONS`."""
HELD_OUT_FRAMES = 4_000
MARGIN = 0.5
"""A choice must stay within this share of the gate's limits on the held-out rounds, because the
first of many choices that passes can have passed by chance."""
LIMITS = {"distance_m": 0.003, "angle_rad": 0.0002, "accuracy": 0.001}
"""Maximum increase of an error over float32: m, rad, and share of the frames."""


def calibration_images(train: Frames) -> NDArray[np.uint8]:
    """Read 300 evenly spaced frames (N, H, W, 3) of the train rounds, or all if there are fewer."""
    count = min(CALIBRATION_FRAMES, len(train))
    return train.read_batch(np.linspace(0, len(train) - 1, count).astype(np.int64))


def choose_float_activations(
    model: Any, images: NDArray[np.uint8], held_out: Frames, mean: dict[str, Any]
) -> tuple[int, ...]:
    """Choose the convolutions that keep float activations, on held-out train rounds; returns their
    indices in topological order.

    `model`: an `openvino.Model`; `images` (N, H, W, 3): frames for the calibration; `mean`: means
    of the training labels. The choices are tried in this order: no convolution; each convolution
    alone, from the fewest multiplications up; the best single convolution together with each second
    one; the best pair together with each third one. The first choice with which no error grows by
    more than half its limit (`LIMITS`) is returned; if there is none, the choice with the smallest
    growth relative to the limits. For a network with more than 16 convolutions, nothing is tried
    and `FLOAT_ACTIVATIONS` is returned.
    """
    rows = np.linspace(0, len(held_out) - 1, min(HELD_OUT_FRAMES, len(held_out))).astype(np.int64)
    frames, labels = held_out.read_batch(rows), model_labels(held_out).take(rows)

    def judged(graph: Any) -> dict[str, Any]:
        outputs = run_graph(graph, "f32", frames)
        return {"split": "held out", **evaluate_outputs(outputs, labels, mean)}

    order = convolutions_by_work(model)
    if len(order) > MAX_CONVOLUTIONS:
        return FLOAT_ACTIVATIONS
    reference, excess = judged(model), {}
    candidates: list[tuple[int, ...]] = [()]
    for _ in range(MAX_FLOAT_ACTIVATIONS + 1):
        for choice in candidates:
            found = gate(reference, judged(quantise(model, images, choice)))
            shares = (by / _limit(name) for name, by in found["worse"].items())
            excess[choice] = max(shares, default=np.inf)
            if found["passed"] and excess[choice] <= MARGIN:
                return choice
        best = min(candidates, key=lambda choice: excess[choice])
        candidates = [(*best, number) for number in order if number not in best]
    return min(excess, key=lambda choice: excess[choice])


def convolutions_by_work(model: Any) -> list[int]:
    """Return the indices, in topological order, of the convolutions of an `openvino.Model`, sorted
    from the fewest multiplications up."""
    operations = [op for op in model.get_ordered_ops() if op.get_type_name() == "Convolution"]
    work = [
        int(np.prod(list(op.get_output_shape(0))[2:])) * int(np.prod(list(op.get_input_shape(1))))
        for op in operations
    ]
    return sorted(range(len(work)), key=lambda number: work[number])


def quantise(
    model: Any, images: NDArray[np.uint8], float_activations: Sequence[int] = FLOAT_ACTIVATIONS
) -> Any:
    """Quantise an `openvino.Model` to int8, calibrated on `images` (N, H, W, 3); returns the new
    model.

    `float_activations`: indices, in topological order, of the convolutions whose activations stay
    in float.
    """
    # Without this variable NNCF sends usage statistics.
    os.environ["NNCF_CI"] = "1"
    import nncf

    nncf.set_log_level(logging.ERROR)
    with redirect_stdout(sys.stderr):  # NNCF's progress bars must not mix with results
        quantised = nncf.quantize(
            model,
            nncf.Dataset([image[None] for image in images]),
            subset_size=len(images),
            preset=nncf.QuantizationPreset.PERFORMANCE,
            ignored_scope=nncf.IgnoredScope(names=float_operations(model, float_activations)),
        )
        return nncf.compress_weights(
            quantised,
            mode=nncf.CompressWeightsMode.INT8_SYM,
            ignored_scope=nncf.IgnoredScope(names=float_weights(model)),
        )


def operation_names(model: Any, kind: str) -> list[str]:
    """Return the names of the operations of type `kind` (such as "Convolution") of an
    `openvino.Model`, in topological order."""
    operations = model.get_ordered_ops()
    return [op.get_friendly_name() for op in operations if op.get_type_name() == kind]


def float_weights(model: Any) -> list[str]:
    """Return the names of the MatMul operations of an `openvino.Model` whose weights are not
    quantised: the last shared layer, the heads, and all others outside the shared layers."""
    products = operation_names(model, "MatMul")
    shared = [name for name in products if ".shared." in name]
    return [name for name in products if name not in shared[:-1]]


def float_operations(model: Any, chosen: Sequence[int]) -> list[str]:
    """Return the names of the operations of an `openvino.Model` whose activations are not
    quantised.

    These are the convolutions with the indices `chosen`, and all operations whose results do not
    enter a convolution: shared layers, heads, and the texture features of the uncertainty head.
    """
    convolutions = operation_names(model, "Convolution")
    before = set(convolutions)
    operations = model.get_ordered_ops()
    for op in reversed(operations):
        if op.get_friendly_name() in before:
            before.update(value.get_node().get_friendly_name() for value in op.input_values())
    values = ("Constant", "Parameter", "Result")
    after = [
        name
        for op in operations
        if op.get_type_name() not in values and (name := op.get_friendly_name()) not in before
    ]
    return [*(convolutions[number] for number in chosen), *after]


def judge(run: Path, data: Path) -> dict[str, Any]:
    """Evaluate a run's int8 graph on the test rounds of the dataset `data`, and compare it with
    float32; returns the result of `gate`.

    The result also has "native_int8": whether the processor of this evaluation multiplies int8
    natively.
    """

    def evaluated(precision: Literal["f32", "int8"]) -> dict[str, Any]:
        engines = [load_engine(run, "openvino", precision) for _ in range(os.cpu_count() or 1)]
        return evaluate(engines, data, "test")

    return {**gate(evaluated("f32"), evaluated("int8")), "native_int8": has_int8()}


def gate(reference: dict[str, Any], quantised: dict[str, Any]) -> dict[str, Any]:
    """Compare the evaluation of a quantised model with the float32 evaluation on the same frames.

    The result has the keys "passed", "failed" (names of features), "split", "frames", "limits" and
    "worse" (increase of the mean error of each feature). The limits are `LIMITS`: 0.003 m for a
    marking and the offset from the lane centre, 0.0002 rad for the angle, and 0.001 for the share
    of wrong classes. A feature without labels is not judged. A feature fails if only one of the
    evaluations has an error for it.
    """
    pairs = {
        **{name: (reference["mae_m"][name], value) for name, value in quantised["mae_m"].items()},
        "to_lane_centre": (reference["to_lane_centre_mae_m"], quantised["to_lane_centre_mae_m"]),
        "angle": (reference["angle_mae_rad"], quantised["angle_mae_rad"]),
        "accuracy": (quantised["heading_accuracy"], reference["heading_accuracy"]),
    }
    worse = {
        name: after - before
        for name, (before, after) in pairs.items()
        if before is not None and after is not None
    }
    lost = [name for name, pair in pairs.items() if (pair[0] is None) != (pair[1] is None)]
    # `not ... <=` instead of `>`, so that a NaN fails.
    failed = [name for name, by in worse.items() if not by <= _limit(name)]
    return {
        "passed": not failed and not lost and bool(worse),
        "failed": failed + lost,
        "split": reference["split"],
        "frames": reference["frames"],
        "limits": LIMITS,
        "worse": worse,
    }


def _limit(name: str) -> float:
    """Return the maximum increase of a feature's error (m or rad), or of the share of wrong
    classes."""
    return LIMITS[{"angle": "angle_rad", "accuracy": "accuracy"}.get(name, "distance_m")]

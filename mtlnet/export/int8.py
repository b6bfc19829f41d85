"""The int8 form of a graph (by NNCF), and the accuracy gate it must pass (DESIGN §7).

Quantised are the weights and activations of three convolutions, calibrated on training frames, and
the weights alone of the first and third convolution and of the shared layers except the last.
Quantised activations of the first convolution cost more distance accuracy than those of all others
together, of the third more angle accuracy, and save little time. Shared layers take as long as
reading their weights takes; the last is small, and costs as much accuracy as the other two.
"""

import logging
import os
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Frames
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.engine import load_engine

CALIBRATION_FRAMES = 300
FLOAT_ACTIVATIONS = (0, 2)
"""Numbers of the convolutions whose activations are not quantised."""
LIMITS = {"distance_m": 0.003, "angle_rad": 0.0002, "accuracy": 0.001}
"""Largest increase of an error over float32: m, rad, and share of the frames."""


def calibration_images(train: Frames) -> NDArray[np.uint8]:
    """Evenly spaced frames (N, H, W, 3) of the train rounds."""
    count = min(CALIBRATION_FRAMES, len(train))
    return train.read_batch(np.linspace(0, len(train) - 1, count).astype(np.int64))


def quantise(model: Any, images: NDArray[np.uint8]) -> Any:
    """The int8 form of an OpenVINO model, calibrated on `images` (N, H, W, 3)."""
    # Without this NNCF sends usage statistics.
    os.environ["NNCF_CI"] = "1"
    import nncf

    nncf.set_log_level(logging.ERROR)
    with redirect_stdout(sys.stderr):  # NNCF's progress bars must not mix with results
        quantised = nncf.quantize(
            model,
            nncf.Dataset([image[None] for image in images]),
            subset_size=len(images),
            preset=nncf.QuantizationPreset.PERFORMANCE,
            ignored_scope=nncf.IgnoredScope(names=float_operations(model)),
        )
        return nncf.compress_weights(
            quantised,
            mode=nncf.CompressWeightsMode.INT8_SYM,
            ignored_scope=nncf.IgnoredScope(names=operation_names(model, "MatMul")[-1:]),
        )


def operation_names(model: Any, kind: str) -> list[str]:
    """Names of a model's operations of that type, in topological order."""
    operations = model.get_ordered_ops()
    return [op.get_friendly_name() for op in operations if op.get_type_name() == kind]


def float_operations(model: Any) -> list[str]:
    """Names of the operations whose activations are not quantised.

    These are the convolutions `FLOAT_ACTIVATIONS`, and everything no convolution depends on: shared
    layers, heads and texture features.
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
    return [*(convolutions[number] for number in FLOAT_ACTIVATIONS), *after]


def judge(run: Path, data: Path) -> dict[str, Any]:
    """The gate's result for a run's int8 graph, on the test rounds of a dataset."""

    def evaluated(precision: Literal["f32", "int8"]) -> dict[str, Any]:
        engines = [load_engine(run, "openvino", precision) for _ in range(os.cpu_count() or 1)]
        return evaluate(engines, data, "test")

    return gate(evaluated("f32"), evaluated("int8"))


def gate(reference: dict[str, Any], quantised: dict[str, Any]) -> dict[str, Any]:
    """Compare the evaluation of a quantised model with that in float32 on the same frames.

    The result has "passed", "failed" (names), "split", "frames", "limits" and "worse" (name: error
    increase). Each marking and the offset from the lane centre are held to the limit of a distance.
    Features without labels are not judged; one that only one of the evaluations has fails.
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
    limits = {"angle": LIMITS["angle_rad"], "accuracy": LIMITS["accuracy"]}
    # Written so that a NaN fails.
    failed = [
        name for name, by in worse.items() if not by <= limits.get(name, LIMITS["distance_m"])
    ]
    return {
        "passed": not failed and not lost and bool(worse),
        "failed": failed + lost,
        "split": reference["split"],
        "frames": reference["frames"],
        "limits": LIMITS,
        "worse": worse,
    }

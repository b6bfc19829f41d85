"""The int8 form of a graph, and the gate it has to pass (DESIGN §7).

By NNCF. Three convolutions are quantised, weights and activations, calibrated on training frames;
of the first and the third the weights alone are int8, for rounded activations cost there more
accuracy than in all others (in the first of distances, in the third of the angle) and save little.
So are the weights of the shared layers, whose time is that of reading them, but the last: it is
small, and costs as much accuracy as both others.
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
from mtlnet.inference.exported import gate

CALIBRATION_FRAMES = 300
EXACT_CONVOLUTIONS = (0, 2)  # their activations


def calibration_images(train: Frames) -> NDArray[np.uint8]:
    """Frames (N, H, W, 3) from all over the train rounds."""
    count = min(CALIBRATION_FRAMES, len(train))
    return train.read_batch(np.linspace(0, len(train) - 1, count).astype(np.int64))


def quantise(model: Any, images: NDArray[np.uint8]) -> Any:
    """The int8 form of a graph, calibrated on `images` (N, H, W, 3)."""
    # NNCF tells its makers of every use unless it is said to run in a test.
    os.environ["NNCF_CI"] = "1"
    import nncf

    nncf.set_log_level(logging.ERROR)
    with redirect_stdout(sys.stderr):  # its progress bars are no result
        quantised = nncf.quantize(
            model,
            nncf.Dataset([image[None] for image in images]),
            subset_size=len(images),
            preset=nncf.QuantizationPreset.PERFORMANCE,
            ignored_scope=nncf.IgnoredScope(names=exact_operations(model)),
        )
        return nncf.compress_weights(
            quantised,
            mode=nncf.CompressWeightsMode.INT8_SYM,
            ignored_scope=nncf.IgnoredScope(names=names_of(model, "MatMul")[-1:]),
        )


def names_of(model: Any, kind: str) -> list[str]:
    """The operations of that kind in a graph, in their order."""
    operations = model.get_ordered_ops()
    return [op.get_friendly_name() for op in operations if op.get_type_name() == kind]


def exact_operations(model: Any) -> list[str]:
    """Some convolutions, and all that no convolution depends on: shared layers, heads, texture."""
    convolutions = names_of(model, "Convolution")
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
    return [*(convolutions[which] for which in EXACT_CONVOLUTIONS), *after]


def judge(run: Path, data: Path) -> dict[str, Any]:
    """The gate's result for a run's int8 graph on the test rounds of a dataset, against float32."""

    def evaluated(precision: Literal["f32", "int8"]) -> dict[str, Any]:
        engines = [load_engine(run, "openvino", precision) for _ in range(os.cpu_count() or 1)]
        return evaluate(engines, data, "test")

    return gate(evaluated("f32"), evaluated("int8"))

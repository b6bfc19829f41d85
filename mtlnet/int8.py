"""The int8 form of a graph, and the gate it has to pass (DESIGN §7).

The convolutions are quantised by NNCF, weights and activations, calibrated on training frames. Of
the shared layers the weights alone are int8: what the heads read costs as much accuracy, rounded,
as all the rest, and the time of those layers is that of reading their weights.
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
from mtlnet.engine import load_engine
from mtlnet.evaluate import evaluate
from mtlnet.exported import gate

CALIBRATION_FRAMES = 300
# Element-wise products are the heads', means of cells the texture's (`mtlnet.precise`): left in
# float32.
EXACT = ("Multiply", "ReduceSum", "Subtract", "Power", "AvgPool", "ReduceMean")


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
            preset=nncf.QuantizationPreset.MIXED,
            ignored_scope=nncf.IgnoredScope(types=["MatMul", *EXACT], validate=False),
        )
        return nncf.compress_weights(quantised, mode=nncf.CompressWeightsMode.INT8_SYM)


def judge(run: Path, data: Path) -> dict[str, Any]:
    """The gate's result for a run's int8 graph on the test rounds of a dataset, against float32."""

    def evaluated(precision: Literal["f32", "int8"]) -> dict[str, Any]:
        engines = [load_engine(run, "openvino", precision) for _ in range(os.cpu_count() or 1)]
        return evaluate(engines, data, "test")

    return gate(evaluated("f32"), evaluated("int8"))

"""The int8 form of a graph, and the gate it has to pass (DESIGN §7).

Weights and activations are quantised by NNCF, calibrated on training frames. What the heads read is
left exact: rounded, it costs as much accuracy as all other layers together. Where that is not
enough, more of the last layers are, for a little time each.
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
MOST_LEFT = 3
"""Of the last shared layers: so many at most are left as they are."""


def calibration_images(train: Frames) -> NDArray[np.uint8]:
    """Frames (N, H, W, 3) from all over the train rounds."""
    count = min(CALIBRATION_FRAMES, len(train))
    return train.read_batch(np.linspace(0, len(train) - 1, count).astype(np.int64))


def quantise(model: Any, images: NDArray[np.uint8], left: int = 1) -> Any:
    """The int8 form of a graph but for its last `left` shared layers, calibrated on `images`."""
    # NNCF tells its makers of every use unless it is said to run in a test.
    os.environ["NNCF_CI"] = "1"
    import nncf

    nncf.set_log_level(logging.ERROR)
    shared = [n.get_friendly_name() for n in model.get_ordered_ops() if _is_shared(n)]
    with redirect_stdout(sys.stderr):  # its progress bars are no result
        return nncf.quantize(
            model,
            nncf.Dataset([image[None] for image in images]),
            subset_size=len(images),
            preset=nncf.QuantizationPreset.MIXED,
            ignored_scope=nncf.IgnoredScope(
                names=shared[len(shared) - left :], types=list(EXACT), validate=False
            ),
        )


def _is_shared(node: Any) -> bool:
    return bool(node.get_type_name() == "MatMul")


class Gate:
    """Judges int8 graphs of a run on the test rounds of a dataset, against float32."""

    def __init__(self, run: Path, data: Path) -> None:
        self.run, self.data = run, data
        self._exact: dict[str, Any] | None = None

    def judge(self) -> dict[str, Any]:
        """The gate's result for the int8 graph that the run has now."""
        if self._exact is None:
            self._exact = self._evaluate("f32")
        return gate(self._exact, self._evaluate("int8"))

    def _evaluate(self, precision: Literal["f32", "int8"]) -> dict[str, Any]:
        engines = [load_engine(self.run, "openvino", precision) for _ in range(os.cpu_count() or 1)]
        return evaluate(engines, self.data, "test")

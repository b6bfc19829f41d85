"""Writing the trained network as OpenVINO IR: what `serve` loads, without torch.

The graph is built operation by operation from the weights, not traced: it uses OpenVINO's own SAME
padding (`mtlnet.graph_layers`) and so is an independent check. No converter, hence no telemetry.
"""

import errno
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtlnet.doubt import Doubt
from mtlnet.graph_layers import features_graph
from mtlnet.network import Network
from mtlnet.plan import HEADS, HEIGHT, WIDTH
from mtlnet.precise import doubt_outputs, precise_linear

# Largest difference of any output (coded, or a probability) from torch in float32.
TOLERANCE = 2e-4
DOUBT_TOLERANCE = 5e-3
"""The same of a standard deviation or the novelty, as a share of it."""


def build_graph(network: Network, doubt: Doubt | None = None) -> Any:
    """The OpenVINO model of a folded network: uint8 (1, 210, 280, 3) -> float32 (1, 9).

    With `doubt` (1, 17): see `mtlnet.answer`.
    """
    import openvino
    from openvino import opset13 as ops

    images, pixels, x, nine = _network_graph(ops, network)
    second = [] if doubt is None else doubt_outputs(ops, x, pixels, doubt)
    outputs = ops.concat([nine, *second], 1)
    return openvino.Model([ops.result(outputs)], [images], "mtlnet")


def describing_graph(network: Network) -> Any:
    """The same with two results: the nine outputs, and the last shared features (1, F)."""
    import openvino
    from openvino import opset13 as ops

    images, _, x, nine = _network_graph(ops, network)
    return openvino.Model([ops.result(nine), ops.result(x)], [images], "mtlnet")


def _network_graph(ops: Any, network: Network) -> tuple[Any, Any, Any, Any]:
    """As nodes: the images, their pixels (1, 3, H, W) in [-1, 1], the last shared features, the
    nine outputs."""
    weights = {name: t.detach().cpu().numpy() for name, t in network.state_dict().items()}
    images = ops.parameter([1, HEIGHT, WIDTH, 3], np.uint8, name="images")
    x = ops.convert(images, np.float32)
    x = ops.subtract(ops.multiply(x, np.float32(1 / 127.5)), np.float32(1))
    pixels = ops.transpose(x, np.array([0, 3, 1, 2]))
    x = features_graph(ops, pixels, network)
    for number in range(len(network.plan.shared)):
        x = ops.relu(_linear(ops, x, weights, f"shared.fc{number}.layer"))
    distance, angle, kind = (
        precise_linear(ops, x, weights[f"heads.{name}.weight"], weights[f"heads.{name}.bias"])
        for name, _ in HEADS
    )
    return images, pixels, x, ops.concat([distance, angle, ops.softmax(kind, 1)], 1)


def _linear(ops: Any, x: Any, weights: dict[str, NDArray[np.float32]], name: str) -> Any:
    product = ops.matmul(x, weights[f"{name}.weight"], False, True)
    return ops.add(product, weights[f"{name}.bias"][None])


def write_graph(network: Network, graph: Path, weights: Path, doubt: Doubt | None = None) -> None:
    """Write the graph to `graph` (.xml) and its weights, in float32, to `weights` (.bin).

    Raises OSError when the disk takes neither; both are then as they were.
    """
    import openvino

    # OpenVINO names the weights after the graph, so both are written under another stem first.
    staged = graph.with_name("staged.xml")
    try:
        openvino.save_model(build_graph(network, doubt), str(staged), compress_to_fp16=False)
        staged.with_suffix(".bin").replace(weights)
        staged.replace(graph)
    except RuntimeError as error:  # how OpenVINO says that a write failed, without the reason
        reason = "OpenVINO could not write the model's graph; is the disk full?"
        raise OSError(errno.EIO, reason, str(graph)) from error
    finally:
        staged.unlink(missing_ok=True)
        staged.with_suffix(".bin").unlink(missing_ok=True)

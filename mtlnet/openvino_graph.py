"""A trained torch network as an OpenVINO model, which `serve` loads without torch.

The graph is built by `mtlnet.inference.graph`; only torchvision's backbones are translated here,
with torch.fx.
"""

import errno
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mtlnet.inference.engine import openvino_core
from mtlnet.inference.graph import Nodes, convolution, model_of, network_nodes
from mtlnet.inference.uncertainty import UncertaintyHead
from mtlnet.model.network import Network
from runtime.files import fsync_path, utf8_path

TOLERANCE = 2e-4
"""Tolerance: largest absolute difference of an output (coded value or probability) from torch in
float32."""
UNCERTAINTY_TOLERANCE = 5e-3
"""Tolerance: largest relative difference of a standard deviation or the OOD score."""


def build_graph(network: Network, head: UncertaintyHead | None = None, batch: int = 1) -> Any:
    """OpenVINO model of a folded network: uint8 images (B, 210, 280, 3) -> float32 (B, 9 to 22).

    `mtlnet.inference.prediction.split_outputs` describes the columns. `batch`: number of images;
    -1: any number, which is slower for a single image.
    """
    return model_of(_nodes(network, batch), head)


def build_feature_graph(network: Network) -> Any:
    """OpenVINO model with two results: the nine outputs and the inputs (1, F) of the uncertainty
    head."""
    import openvino
    from openvino import opset13 as ops

    nodes = _nodes(network)
    results = [ops.result(nodes.outputs), ops.result(nodes.uncertainty_inputs)]
    return openvino.Model(results, [nodes.images], "mtlnet")


def write_graph(
    network: Network, graph: Path, weights: Path, head: UncertaintyHead | None = None
) -> None:
    """Write the graph to `graph` (.xml) and its float32 weights to `weights` (.bin).

    Raises OSError when writing fails, for example on a full disk; both files are then unchanged.
    """
    import openvino

    # OpenVINO names the weights after the graph, so both are first written under another name.
    staged = graph.with_name("staged.xml")
    try:
        with utf8_path(staged) as plain:
            openvino.save_model(build_graph(network, head), str(plain), compress_to_fp16=False)
        for path in (staged, staged.with_suffix(".bin")):
            fsync_path(path)
        staged.with_suffix(".bin").replace(weights)
        staged.replace(graph)
        fsync_path(graph.parent)
    except RuntimeError as error:  # OpenVINO's error for a failed write; it gives no reason
        reason = "OpenVINO could not write the model's graph; is the disk full?"
        raise OSError(errno.EIO, reason, str(graph)) from error
    finally:
        staged.unlink(missing_ok=True)
        staged.with_suffix(".bin").unlink(missing_ok=True)


def run_graph(
    graph: Any, precision: str, images: NDArray[np.uint8], batch: int = 1
) -> NDArray[np.float32]:
    """Outputs (N, 9 to 22) of an OpenVINO model for images (N, 210, 280, 3).

    `graph`: the model or the path of its file; `batch`: images per inference. Raises RuntimeError
    when OpenVINO cannot load it.
    """
    options = {"INFERENCE_PRECISION_HINT": precision, "NUM_STREAMS": 1}
    source = str(graph) if isinstance(graph, Path) else graph
    request = openvino_core().compile_model(source, "CPU", options).create_infer_request()
    parts = (images[first : first + batch] for first in range(0, len(images), batch))
    return np.concatenate([request.infer([part])[0].copy() for part in parts])


def _nodes(network: Network, batch: int = 1) -> Nodes:
    from openvino import opset13 as ops

    def backbone(pixels: Any) -> Any:
        return backbone_graph(ops, pixels, network.features)

    architecture = network.architecture
    weights = {name: _array(tensor) for name, tensor in network.state_dict().items()}
    features = backbone if architecture.backbone else None
    return network_nodes(ops, architecture, weights, features, batch)


def backbone_graph(ops: Any, x: Any, backbone: nn.Module) -> Any:
    """Graph of a torchvision backbone with folded batch normalisation, (B, 3, H, W) -> (B, F, 1,
    1).

    Raises NotImplementedError for a layer that no backbone of `mtlnet.architecture` uses.
    """
    values: dict[torch.fx.Node, Any] = {}
    traced = torch.fx.symbolic_trace(backbone)
    for node in traced.graph.nodes:
        if node.op == "placeholder":
            values[node] = x
            continue
        if node.op == "output":
            return values[node.args[0]]
        inputs = [values[a] for a in node.args if isinstance(a, torch.fx.Node)]
        if node.op == "call_module":
            values[node] = _module(ops, inputs[0], traced.get_submodule(node.target))
        elif node.target in _FUNCTIONS:
            values[node] = _FUNCTIONS[node.target](ops, *inputs)
        else:
            raise NotImplementedError(f"no OpenVINO operation for {node.format_node()}")
    raise NotImplementedError("the backbone has no output")


def _module(ops: Any, x: Any, module: nn.Module) -> Any:
    if isinstance(module, nn.Conv2d):
        return _convolution(ops, x, module)
    for kind, make in _MODULES.items():
        if isinstance(module, kind):
            return make(ops, x)
    raise NotImplementedError(f"no OpenVINO operation for {module}")


def _convolution(ops: Any, x: Any, layer: nn.Conv2d) -> Any:
    assert isinstance(layer.padding, tuple)
    assert set(layer.dilation) == {1}
    stride, pads = list(layer.stride), list(layer.padding)
    x = convolution(ops, x, _array(layer.weight), stride, pads, layer.groups)
    return x if layer.bias is None else ops.add(x, _array(layer.bias).reshape(1, -1, 1, 1))


def _average(ops: Any, x: Any) -> Any:
    """Mean over rows and columns; all adaptive pools of the backbones have output size 1 x 1."""
    return ops.reduce_mean(x, np.array([2, 3]), keep_dims=True)


_MODULES: dict[type[nn.Module], Callable[[Any, Any], Any]] = {
    nn.Identity: lambda ops, x: x,
    nn.ReLU: lambda ops, x: ops.relu(x),
    nn.Hardswish: lambda ops, x: ops.hswish(x),
    nn.Hardsigmoid: lambda ops, x: ops.hsigmoid(x),
    nn.Sigmoid: lambda ops, x: ops.sigmoid(x),
    nn.AdaptiveAvgPool2d: _average,
}
_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    operator.add: lambda ops, a, b: ops.add(a, b),
    operator.mul: lambda ops, a, b: ops.multiply(a, b),
    # Flattened after the features.
    torch.flatten: lambda ops, x: x,
    "flatten": lambda ops, x: x,
}


def _array(tensor: torch.Tensor) -> NDArray[np.float32]:
    """The weights as a contiguous array."""
    values: NDArray[np.float32] = np.ascontiguousarray(tensor.detach().cpu().numpy())
    return values

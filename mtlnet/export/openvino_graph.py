"""The trained network as an OpenVINO model: what `serve` loads, without torch.

The graph is built operation by operation from the weights, not traced, with OpenVINO's own SAME
padding: an implementation independent of torch's. Only torchvision backbones are walked with
torch.fx.

The heads and the uncertainty head are computed in float32 also where the rest is in bf16. OpenVINO
rounds the results of a MatMul to bf16, in steps of 0.004 near 1, which is 0.025 m and 0.005 rad;
element-wise operations at the end of a graph stay in float32.
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

from mtlnet.inference.uncertainty import (
    BANDS,
    CELL_COLUMNS,
    CELL_ROWS,
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    SQRT_EPSILON,
    UncertaintyHead,
)
from mtlnet.model.architecture import HEADS, HEIGHT, WIDTH, LocalNorm, Pool
from mtlnet.model.network import Network

TOLERANCE = 2e-4
"""Largest difference of any output (coded, or a probability) from torch in float32."""
UNCERTAINTY_TOLERANCE = 5e-3
"""Largest relative difference of a standard deviation or the OOD score."""


# The model and its file.


def build_graph(network: Network, head: UncertaintyHead | None = None) -> Any:
    """OpenVINO model of a folded network: uint8 images (1, 210, 280, 3) -> float32 (1, 9).

    With an uncertainty head (1, 17); see `mtlnet.inference.prediction`.
    """
    import openvino
    from openvino import opset13 as ops

    images, pixels, x, outputs = _network_graph(ops, network)
    uncertainty = [] if head is None else uncertainty_outputs(ops, x, pixels, head)
    result = ops.result(ops.concat([outputs, *uncertainty], 1))
    return openvino.Model([result], [images], "mtlnet")


def build_feature_graph(network: Network) -> Any:
    """The same with two results: the nine outputs, and the last shared features (1, F)."""
    import openvino
    from openvino import opset13 as ops

    images, _, x, outputs = _network_graph(ops, network)
    return openvino.Model([ops.result(outputs), ops.result(x)], [images], "mtlnet")


def write_graph(
    network: Network, graph: Path, weights: Path, head: UncertaintyHead | None = None
) -> None:
    """Write the graph to `graph` (.xml) and its weights, in float32, to `weights` (.bin).

    Raises OSError when writing fails, for example on a full disk; both files are then unchanged.
    """
    import openvino

    # OpenVINO names the weights after the graph, so both are first written under another stem.
    staged = graph.with_name("staged.xml")
    try:
        openvino.save_model(build_graph(network, head), str(staged), compress_to_fp16=False)
        staged.with_suffix(".bin").replace(weights)
        staged.replace(graph)
    except RuntimeError as error:  # OpenVINO's error for a failed write; it gives no reason
        reason = "OpenVINO could not write the model's graph; is the disk full?"
        raise OSError(errno.EIO, reason, str(graph)) from error
    finally:
        staged.unlink(missing_ok=True)
        staged.with_suffix(".bin").unlink(missing_ok=True)


def _network_graph(ops: Any, network: Network) -> tuple[Any, Any, Any, Any]:
    """Nodes: images, pixels (1, 3, H, W) in [-1, 1], last shared features, outputs (1, 9)."""
    weights = {name: t.detach().cpu().numpy() for name, t in network.state_dict().items()}
    images = ops.parameter([1, HEIGHT, WIDTH, 3], np.uint8, name="images")
    x = ops.convert(images, np.float32)
    x = ops.subtract(ops.multiply(x, np.float32(1 / 127.5)), np.float32(1))
    pixels = ops.transpose(x, np.array([0, 3, 1, 2]))
    x = features_graph(ops, pixels, network)
    for number in range(len(network.architecture.shared)):
        layer = f"shared.fc{number}.layer"
        product = ops.matmul(x, weights[f"{layer}.weight"], False, True)
        x = ops.relu(ops.add(product, weights[f"{layer}.bias"][None]))
    distance, angle, heading = (
        linear_float32(ops, x, weights[f"heads.{name}.weight"], weights[f"heads.{name}.bias"])
        for name, _ in HEADS
    )
    return images, pixels, x, ops.concat([distance, angle, ops.softmax(heading, 1)], 1)


# The layers before the heads.


def features_graph(ops: Any, x: Any, network: Network) -> Any:
    """The features of a folded network, (1, 3, H, W) -> (1, F)."""
    if network.architecture.backbone:
        x = backbone_graph(ops, x, network.features)
    else:
        x = layers_graph(ops, x, network)
    return ops.reshape(x, np.array([1, -1]), special_zero=False)


def layers_graph(ops: Any, x: Any, network: Network) -> Any:
    """The layers listed in the network's architecture, (1, 3, H, W) -> (1, C, h, w)."""
    for number, spec in enumerate(network.architecture.features):
        if isinstance(spec, LocalNorm):
            x = ops.lrn(x, np.array([1]), spec.alpha, spec.beta, 1.0, spec.size)
        elif isinstance(spec, Pool):
            sizes = ([spec.stride] * 2, [1, 1], [0, 0], [0, 0], [spec.kernel] * 2)
            how = {"auto_pad": "same_upper"} if spec.same else {"rounding_type": "ceil"}
            x = ops.max_pool(x, *sizes, **how).output(0)
        else:
            layer = network.features.get_submodule(f"conv{number}.layer")
            x = ops.relu(convolution(ops, x, layer, same=spec.pad is None))
    return x


def convolution(ops: Any, x: Any, layer: nn.Module, *, same: bool = False) -> Any:
    """A convolution with optional bias and groups; `same`: TensorFlow's SAME padding."""
    assert isinstance(layer, nn.Conv2d)
    assert isinstance(layer.padding, tuple)
    weight, groups = _array(layer.weight), layer.groups
    convolve = ops.convolution
    if groups > 1:
        outputs, inputs, *kernel = weight.shape
        weight = weight.reshape(groups, outputs // groups, inputs, *kernel)
        convolve = ops.group_convolution
    pad, how = list(layer.padding), {"auto_pad": "same_upper"} if same else {}
    x = convolve(x, weight, list(layer.stride), pad, pad, list(layer.dilation), **how)
    return x if layer.bias is None else ops.add(x, _array(layer.bias).reshape(1, -1, 1, 1))


def backbone_graph(ops: Any, x: Any, backbone: nn.Module) -> Any:
    """A torchvision backbone without batch normalisation (folded), (1, 3, H, W) -> (1, F, 1, 1).

    Raises NotImplementedError for a layer that no backbone of `mtlnet.model.architecture` uses.
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
        return convolution(ops, x, module)
    for kind, make in _MODULES.items():
        if isinstance(module, kind):
            return make(ops, x)
    raise NotImplementedError(f"no OpenVINO operation for {module}")


def _average(ops: Any, x: Any) -> Any:
    """Mean over rows and columns: all adaptive pools of the backbones have output size 1 x 1."""
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
    # Flattened by `features_graph`.
    torch.flatten: lambda ops, x: x,
    "flatten": lambda ops, x: x,
}


def _array(tensor: torch.Tensor) -> NDArray[np.float32]:
    """Weights as a contiguous array."""
    values: NDArray[np.float32] = np.ascontiguousarray(tensor.detach().cpu().numpy())
    return values


# Outputs in float32, and the uncertainty head.


def product_float32(ops: Any, x: Any, weight: NDArray[np.float32]) -> Any:
    """x (1, F) times weight (N, F) transposed: (1, N)."""
    # In two dimensions: OpenVINO would lay out three as the channels of an image, and back.
    sums = ops.reduce_sum(ops.multiply(x, weight), np.array([1]))
    return ops.unsqueeze(sums, np.array([0]))


def linear_float32(ops: Any, x: Any, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Any:
    """Linear layer with weight (N, F) and bias (N,) on x (1, F): (1, N)."""
    return ops.add(product_float32(ops, x, weight), bias[None])


def uncertainty_outputs(ops: Any, x: Any, pixels: Any, head: UncertaintyHead) -> list[Any]:
    """`UncertaintyHead.predict` of last shared features x (1, F) and pixels (1, 3, H, W)."""
    z = ops.multiply(ops.subtract(x, head.centre[None]), head.scale[None])
    hidden = ops.relu(linear_float32(ops, z, head.hidden_weight, head.hidden_bias))
    log_std = linear_float32(ops, hidden, head.weight, head.bias)
    limited = ops.minimum(ops.maximum(log_std, head.low[None]), head.high[None])
    cells, centre = texture_graph(ops, pixels)
    deviation = ops.subtract(cells, head.texture_mean[None])
    projected = product_float32(ops, deviation, head.texture_directions)
    z = ops.multiply(ops.subtract(centre, head.pitch_centre[None]), head.pitch_scale[None])
    hidden = ops.relu(linear_float32(ops, z, head.pitch_hidden_weight, head.pitch_hidden_bias))
    pitch = linear_float32(ops, hidden, head.pitch_weight, head.pitch_bias)
    distance = ops.reduce_sum(ops.multiply(projected, projected), np.array([1]), keep_dims=True)
    return [ops.exp(limited), ops.maximum(distance, ops.multiply(pitch, pitch))]


def texture_graph(ops: Any, pixels: Any) -> tuple[Any, Any]:
    """`mtlnet.inference.uncertainty.texture_features` of pixels (1, 3, H, W): (1, C) and (1, M)."""
    _, _, height, width = pixels.shape
    grey = ops.reduce_mean(pixels, np.array([1]), keep_dims=True)
    planes = [pixels]
    for axis, size in ((3, width), (2, height)):
        ends = np.array([0] * axis + [1] + [0] * (3 - axis))
        longer = ops.pad(grey, np.zeros(4, int), ends, "edge")
        first, last, step = np.array([1]), np.array([size + 1]), np.array([1])
        following = ops.slice(longer, first, last, step, np.array([axis]))
        planes.append(ops.abs(ops.subtract(following, grey)))
    band = [height // (CELL_ROWS * BANDS), width // CELL_COLUMNS]
    narrow = [_means(ops, plane, band) for plane in planes]
    cells = [_means(ops, plane, [BANDS, 1]) for plane in narrow]
    first = np.array([CENTRE_BANDS.start, CENTRE_COLUMNS.start])
    last = np.array([CENTRE_BANDS.stop, CENTRE_COLUMNS.stop])
    steps, axes = np.array([1, 1]), np.array([2, 3])
    centre = [ops.slice(plane, first, last, steps, axes) for plane in narrow]
    return _flat(ops, cells), _flat(ops, centre)


def _means(ops: Any, plane: Any, cell: list[int]) -> Any:
    return ops.avg_pool(plane, cell, [0, 0], [0, 0], cell, False)


def _flat(ops: Any, planes: list[Any]) -> Any:
    """One row: the colours, and the square roots of the differences."""
    colours, *others = planes
    roots = [ops.sqrt(ops.add(plane, np.float32(SQRT_EPSILON))) for plane in others]
    return ops.reshape(ops.concat([colours, *roots], 1), np.array([1, -1]), special_zero=False)

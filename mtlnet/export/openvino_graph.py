"""Writing the trained network as OpenVINO IR: what `serve` loads, without torch.

The graph is built operation by operation from the weights, not traced: it uses OpenVINO's own SAME
padding (`mtlnet.export.openvino_graph`) and so is an independent check. No converter, hence no
telemetry.
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
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    CELL_ROWS,
    SQRT_EPSILON,
    UncertaintyHead,
)
from mtlnet.model.architecture import HEADS, HEIGHT, WIDTH, Architecture, LocalNorm, Pool
from mtlnet.model.network import Network

# Largest difference of any output (coded, or a probability) from torch in float32.
TOLERANCE = 2e-4
UNCERTAINTY_TOLERANCE = 5e-3
"""The same of a standard deviation or the novelty, as a share of it."""


def build_graph(network: Network, doubt: UncertaintyHead | None = None) -> Any:
    """The OpenVINO model of a folded network: uint8 (1, 210, 280, 3) -> float32 (1, 9).

    With `doubt` (1, 17): see `mtlnet.inference.prediction`.
    """
    import openvino
    from openvino import opset13 as ops

    images, pixels, x, nine = _network_graph(ops, network)
    second = [] if doubt is None else uncertainty_outputs(ops, x, pixels, doubt)
    outputs = ops.concat([nine, *second], 1)
    return openvino.Model([ops.result(outputs)], [images], "mtlnet")


def build_feature_graph(network: Network) -> Any:
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
    for number in range(len(network.architecture.shared)):
        x = ops.relu(_linear(ops, x, weights, f"shared.fc{number}.layer"))
    distance, angle, kind = (
        precise_linear(ops, x, weights[f"heads.{name}.weight"], weights[f"heads.{name}.bias"])
        for name, _ in HEADS
    )
    return images, pixels, x, ops.concat([distance, angle, ops.softmax(kind, 1)], 1)


def _linear(ops: Any, x: Any, weights: dict[str, NDArray[np.float32]], name: str) -> Any:
    product = ops.matmul(x, weights[f"{name}.weight"], False, True)
    return ops.add(product, weights[f"{name}.bias"][None])


def write_graph(
    network: Network, graph: Path, weights: Path, doubt: UncertaintyHead | None = None
) -> None:
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


# The layers before the heads as OpenVINO operations, made from the weights one by one. A plan's
# own layers follow the plan, and use OpenVINO's own SAME padding; a torchvision backbone is walked
# module by module, as torch.fx finds them.


def features_graph(ops: Any, x: Any, network: Network) -> Any:
    """The features of a folded network, (1, 3, H, W) -> (1, F)."""
    if network.architecture.backbone:
        x = backbone_graph(ops, x, network.features)
    else:
        x = plan_graph(ops, x, network.architecture, network.features)
    return ops.reshape(x, np.array([1, -1]), special_zero=False)


def plan_graph(ops: Any, x: Any, plan: Architecture, features: nn.Module) -> Any:
    """The layers of a plan."""
    for number, spec in enumerate(plan.features):
        if isinstance(spec, LocalNorm):
            x = ops.lrn(x, np.array([1]), spec.alpha, spec.beta, 1.0, spec.size)
        elif isinstance(spec, Pool):
            x = _pool(ops, x, spec)
        else:
            layer = features.get_submodule(f"conv{number}.layer")
            x = ops.relu(convolution(ops, x, layer, same=spec.pad is None))
    return x


def _pool(ops: Any, x: Any, spec: Pool) -> Any:
    sizes = ([spec.stride] * 2, [1, 1], [0, 0], [0, 0], [spec.kernel] * 2)
    how = {"auto_pad": "same_upper"} if spec.same else {"rounding_type": "ceil"}
    return ops.max_pool(x, *sizes, **how).output(0)


def convolution(ops: Any, x: Any, layer: nn.Module, *, same: bool = False) -> Any:
    """A convolution with bias and, perhaps, groups; `same`: padded as TensorFlow does."""
    assert isinstance(layer, nn.Conv2d)
    assert isinstance(layer.padding, tuple)
    weight, groups = array(layer.weight), layer.groups
    convolve = ops.convolution
    if groups > 1:
        outputs, inputs, *kernel = weight.shape
        weight = weight.reshape(groups, outputs // groups, inputs, *kernel)
        convolve = ops.group_convolution
    pad, how = list(layer.padding), {"auto_pad": "same_upper"} if same else {}
    x = convolve(x, weight, list(layer.stride), pad, pad, list(layer.dilation), **how)
    return x if layer.bias is None else ops.add(x, array(layer.bias).reshape(1, -1, 1, 1))


def backbone_graph(ops: Any, x: Any, backbone: nn.Module) -> Any:
    """A torchvision backbone whose normalisations are folded away.

    Raises NotImplementedError for a layer that no backbone of `mtlnet.model.architecture` has.
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
    raise NotImplementedError("the backbone gives nothing")


def _module(ops: Any, x: Any, module: nn.Module) -> Any:
    if isinstance(module, nn.Conv2d):
        return convolution(ops, x, module)
    for kind, make in _MODULES.items():
        if isinstance(module, kind):
            return make(ops, x)
    raise NotImplementedError(f"no OpenVINO operation for {module}")


def _average(ops: Any, x: Any) -> Any:
    """The mean over rows and columns: every adaptive pool of the backbones is 1 x 1."""
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


def array(tensor: torch.Tensor) -> NDArray[np.float32]:
    """Weights as OpenVINO takes them."""
    values: NDArray[np.float32] = np.ascontiguousarray(tensor.detach().cpu().numpy())
    return values


# Layers of an OpenVINO graph that are computed in float32 where the rest is in bf16. OpenVINO
# rounds what a MatMul gives to bf16, in steps of 0.004 near 1: 0.025 m and 0.005 rad. It leaves
# the element-wise operations that end a graph alone.


def precise_product(ops: Any, x: Any, weight: NDArray[np.float32]) -> Any:
    """x (1, F) times weight (N, F), transposed: (1, N)."""
    # In two dimensions: three are laid out as an image's channels, and back for the sum.
    sums = ops.reduce_sum(ops.multiply(x, weight), np.array([1]))
    return ops.unsqueeze(sums, np.array([0]))


def precise_linear(ops: Any, x: Any, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Any:
    """The linear layer of these weights (N, F) and (N,) on x (1, F): (1, N)."""
    return ops.add(precise_product(ops, x, weight), bias[None])


def uncertainty_outputs(ops: Any, x: Any, pixels: Any, doubt: UncertaintyHead) -> list[Any]:
    """`UncertaintyHead.assess` of the last shared features x (1, F) and pixels (1, 3, H, W) in [-1,
    1]."""
    z = ops.multiply(ops.subtract(x, doubt.centre[None]), doubt.scale[None])
    hidden = ops.relu(precise_linear(ops, z, doubt.hidden_weight, doubt.hidden_bias))
    logarithm = precise_linear(ops, hidden, doubt.weight, doubt.bias)
    limited = ops.minimum(ops.maximum(logarithm, doubt.low[None]), doubt.high[None])
    cells, middle = texture_graph(ops, pixels)
    along = precise_product(ops, ops.subtract(cells, doubt.usual[None]), doubt.directions)
    z = ops.multiply(ops.subtract(middle, doubt.aim_centre[None]), doubt.aim_scale[None])
    seen = ops.relu(precise_linear(ops, z, doubt.aim_hidden_weight, doubt.aim_hidden_bias))
    aim = precise_linear(ops, seen, doubt.aim_weight, doubt.aim_bias)
    strange = ops.reduce_sum(ops.multiply(along, along), np.array([1]), keep_dims=True)
    return [ops.exp(limited), ops.maximum(strange, ops.multiply(aim, aim))]


def texture_graph(ops: Any, pixels: Any) -> tuple[Any, Any]:
    """`mtlnet.inference.uncertainty.texture` of pixels (1, 3, H, W): its cells (1, C) and its
    middle (1, M)."""
    _, _, height, width = pixels.shape
    grey = ops.reduce_mean(pixels, np.array([1]), keep_dims=True)
    planes = [pixels]
    for axis, size in ((3, width), (2, height)):
        ends = np.array([0] * axis + [1] + [0] * (3 - axis))
        longer = ops.pad(grey, np.zeros(4, int), ends, "edge")
        one, all_, by = np.array([1]), np.array([size + 1]), np.array([1])
        later = ops.slice(longer, one, all_, by, np.array([axis]))
        planes.append(ops.abs(ops.subtract(later, grey)))
    band = [height // (CELL_ROWS * BANDS), width // CELL_COLUMNS]
    narrow = [_means(ops, plane, band) for plane in planes]
    cells = [_means(ops, plane, [BANDS, 1]) for plane in narrow]
    first = np.array([CENTRE_BANDS.start, CENTRE_COLUMNS.start])
    last = np.array([CENTRE_BANDS.stop, CENTRE_COLUMNS.stop])
    steps, axes = np.array([1, 1]), np.array([2, 3])
    middle = [ops.slice(plane, first, last, steps, axes) for plane in narrow]
    return _flat(ops, cells), _flat(ops, middle)


def _means(ops: Any, plane: Any, cell: list[int]) -> Any:
    return ops.avg_pool(plane, cell, [0, 0], [0, 0], cell, False)


def _flat(ops: Any, planes: list[Any]) -> Any:
    """Colours as they are and roots of the differences, as one row."""
    colours, *others = planes
    roots = [ops.sqrt(ops.add(plane, np.float32(SQRT_EPSILON))) for plane in others]
    return ops.reshape(ops.concat([colours, *roots], 1), np.array([1, -1]), special_zero=False)

"""The layers before the heads as OpenVINO operations, made from the weights one by one.

A plan's own layers follow the plan, and use OpenVINO's own SAME padding; a torchvision backbone is
walked module by module, as torch.fx finds them.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mtlnet.network import Network
from mtlnet.plan import LocalNorm, Plan, Pool


def features_graph(ops: Any, x: Any, network: Network) -> Any:
    """The features of a folded network, (1, 3, H, W) -> (1, F)."""
    if network.plan.backbone:
        x = backbone_graph(ops, x, network.features)
    else:
        x = plan_graph(ops, x, network.plan, network.features)
    return ops.reshape(x, np.array([1, -1]), special_zero=False)


def plan_graph(ops: Any, x: Any, plan: Plan, features: nn.Module) -> Any:
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

    Raises NotImplementedError for a layer that no backbone of `mtlnet.plan` has.
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

"""Forward pass for training on a CPU. It computes the outputs of `Network.forward` in less time;
evaluation and training on a GPU use `Network.forward`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear, max_pool2d, relu

from mtlnet.architecture import GRID, GRID_RESIDUAL, HEIGHT, MTL, Conv, Pool, same_padding
from mtlnet.model.cpu_kernels.convolutions import (
    convolution_3x3,
    im2col_convolution,
    space_to_depth,
    space_to_depth_convolution,
)
from mtlnet.model.cpu_kernels.norm_pool_relu import norm_pool_relu, pool_arguments
from mtlnet.model.network import Network

MAX_IM2COL_PIXELS = 64
"""Feature maps of at most this many pixels are convolved by `im2col_convolution`."""


FAST = (MTL.features, GRID.features, GRID_RESIDUAL.features)
"""The lists of layers (`Architecture.features`) of the networks that this module implements."""


def training_outputs(
    network: Network, images: Tensor, dtype: torch.dtype, masks: Sequence[Tensor] = ()
) -> Tensor:
    """Compute the network's outputs (B, 9) float32 for images uint8 (B, 210, 280, 3): five coded
    distances and the coded angle (`trackfeatures.coding`), and three class scores before the
    softmax. The heads are computed in float32, all layers before them in `dtype`.

    `masks`: for each shared layer a dropout mask (B, units) with values 0 or 1 / (1 - probability);
    empty: no dropout.
    """
    return network.forward_heads(forward_features(network, images, dtype, masks))


def forward_features(
    network: Network, images: Tensor, dtype: torch.dtype, masks: Sequence[Tensor] = ()
) -> Tensor:
    """Compute the last shared features (B, 256), of type `dtype`, of images uint8 (B, 210, 280, 3).

    `masks`: for each shared layer a dropout mask (B, units) with values 0 or 1 / (1 - probability);
    empty: no dropout.
    """
    return forward_shared(network, forward_grid(network, images, dtype), dtype, masks)


def forward_grid(network: Network, images: Tensor, dtype: torch.dtype) -> Tensor:
    """Compute the features of the last convolution, C channels of h x w px (B, C, h, w), of type
    `dtype`, for images uint8 (B, 210, 280, 3)."""
    layers = network.architecture.features
    above = images.shape[1] - HEIGHT + network.architecture.first_row
    x = space_to_depth(images[:, above:], dtype)
    for number, spec in enumerate(layers):
        if isinstance(spec, Conv):
            after = layers[number + 1] if number + 1 < len(layers) else None
            pool = after if isinstance(after, Pool) else None
            y = _layer(x, number, spec, pool, network.features.get_submodule(f"conv{number}"))
            x = x + y if spec.skip else y
    return x


def forward_shared(
    network: Network, grid: Tensor, dtype: torch.dtype, masks: Sequence[Tensor] = ()
) -> Tensor:
    """Compute the last shared features (B, 256), of type `dtype`, from the features `grid`
    (B, C, h, w) of the last convolution.

    `masks`: for each shared layer a dropout mask (B, units) with values 0 or 1 / (1 - probability);
    empty: no dropout.
    """
    x = grid.flatten(1)
    for number in range(len(network.architecture.shared)):
        layer = network.shared.get_submodule(f"fc{number}.layer")
        assert isinstance(layer, nn.Linear)
        x = relu(linear(x, layer.weight.to(dtype), layer.bias.to(dtype)))
        if masks:
            x = x * masks[number].to(dtype)
    return x


def _layer(x: Tensor, number: int, spec: Conv, pool: Pool | None, block: nn.Module) -> Tensor:
    layer, norm = block.get_submodule("layer"), dict(block.named_children()).get("norm")
    assert isinstance(layer, nn.Conv2d)
    assert norm is None or isinstance(norm, nn.BatchNorm2d)
    if norm is None or not norm.training:
        weight, bias = (layer.weight, layer.bias) if norm is None else _folded(layer, norm)
        y = _convolve(x, number, spec, weight, bias)
        pooled = (
            y if pool is None else max_pool2d(y, **pool_arguments(y.shape[2], y.shape[3], pool))
        )
        return relu(pooled)
    sign = torch.where(norm.weight.detach() < 0, -1.0, 1.0)
    y = _convolve(x, number, spec, layer.weight * sign[:, None, None, None], None)
    return norm_pool_relu(y, sign, norm, pool)


def _folded(layer: nn.Conv2d, norm: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Filters (F, C, k, k) and biases (F,) that compute a convolution and its frozen batch
    normalisation in one."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return layer.weight * scale[:, None, None, None], norm.bias - norm.running_mean * scale


def _convolve(x: Tensor, number: int, spec: Conv, weight: Tensor, bias: Tensor | None) -> Tensor:
    if number == 0:
        return space_to_depth_convolution(x, weight, bias, x.dtype)
    weight = weight.to(x.dtype)
    height, width = x.shape[2:]
    if height * width <= MAX_IM2COL_PIXELS and spec.pad is None:
        y = im2col_convolution(x, weight, spec.stride)
        return y if bias is None else y + bias.to(x.dtype)[:, None, None]
    if spec.pad is not None:
        top = left = spec.pad
    else:
        (_, top, bottom), (_, left, right) = (
            same_padding(size, spec.kernel, spec.stride) for size in (height, width)
        )
        assert (top, left) == (bottom, right)
    typed_bias = None if bias is None else bias.to(x.dtype)
    if (spec.kernel, spec.stride, spec.pad) == (3, 1, 1):
        return convolution_3x3(x, weight, typed_bias)
    return conv2d(x, weight, typed_bias, spec.stride, (top, left))

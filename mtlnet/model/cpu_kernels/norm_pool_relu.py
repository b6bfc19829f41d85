"""Fused batch normalisation, max pooling and ReLU for training.

max(relu(a x + b)) = relu(a max(x) + b) for a >= 0. Therefore pooling is computed first, which saves
three quarters of the work. Where a is negative, the caller of `norm_pool_relu` negates the
preceding convolution's filter, and the function negates a. The statistics are computed over the
batches of all processes (Ioffe and Szegedy 2015, algorithm 1).
"""

from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from mtlnet.architecture import Pool, same_padding
from mtlnet.model.cpu_kernels.elementwise import (
    add_affine,
    add_gradient_sums,
    add_moments,
    affine_relu,
    as_rows,
    in_threads,
    input_gradient,
    part_count,
)

native = torch.ops.aten


def pool_arguments(height: int, width: int, pool: Pool) -> dict[str, Any]:
    """Return the arguments that give `max_pool2d` TensorFlow's SAME padding for maps of `height` x
    `width` px.

    `padding` pads the top and left edges, `ceil_mode` the bottom and right edges. torch pads with
    minus infinity; if a ReLU follows, the result is the same as with zeros
    (`mtlnet.model.network`).
    """
    before = [same_padding(size, pool.kernel, pool.stride)[1] for size in (height, width)]
    return {
        "kernel_size": [pool.kernel] * 2,
        "stride": [pool.stride] * 2,
        "padding": before,
        "ceil_mode": True,
    }


def statistics(x: Tensor) -> tuple[Tensor, Tensor, int]:
    """Compute the mean (C,), the biased variance (C,) and the number of values of each channel of
    `x` (B, C, H, W), over the batches of all processes. Mean and variance are float32 for bf16
    values."""
    values = as_rows(x.detach())
    count = len(values)
    dtype = torch.promote_types(x.dtype, torch.float32)
    origin = x.detach()[0, :, 0, 0].to(dtype)  # subtracted, so that the squares do not cancel
    parts = torch.zeros(part_count(), 2, x.shape[1], dtype=torch.float64)

    def work(part: slice, number: int) -> None:
        add_moments(values[part], origin.numpy(), *parts[number].numpy())

    in_threads(work, count)
    mean, square = parts.sum(0) / count
    variance = (square - mean.square()).clamp_min(0.0)
    mean = mean + origin
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return mean.to(dtype), variance.to(dtype), count
    world = dist.get_world_size()  # each process has the same number of images
    moments = torch.stack([mean, variance + mean.square()])
    dist.all_reduce(moments)
    moments /= world
    mean = moments[0]
    return mean.to(dtype), (moments[1] - mean.square()).to(dtype), count * world


class _NormPoolRelu(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        gain: Tensor,
        shift: Tensor,
        moments: tuple[Tensor, Tensor, int],
        eps: float,
        pool: Pool | None,
    ) -> Tensor:
        mean, variance, ctx.count = moments
        inverse = torch.rsqrt(variance + eps)
        a = gain * inverse
        b = shift - mean * a
        ctx.pool, pooled, places = None, x, None
        if pool is not None:
            ctx.pool = pool_arguments(x.shape[2], x.shape[3], pool)
            pooled, places = max_pool2d(x, **ctx.pool, return_indices=True)
        y = torch.empty_like(pooled, memory_format=torch.channels_last)
        inputs, outputs = as_rows(pooled), as_rows(y)

        def work(part: slice, _: int) -> None:
            affine_relu(inputs[part], a.numpy(), b.numpy(), outputs[part])

        in_threads(work, len(inputs))
        ctx.save_for_backward(x, pooled, a, b, mean, inverse, places)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None, None]:
        x, pooled, a, b, mean, inverse, places = ctx.saved_tensors
        given, values, affine = as_rows(gradients[0]), as_rows(pooled), (a.numpy(), b.numpy())
        parts = torch.zeros(part_count(), 2, len(a), dtype=torch.float64)

        def sum_part(part: slice, number: int) -> None:
            sums = parts[number].numpy()
            add_gradient_sums(given[part], values[part], *affine, mean.numpy(), *sums)

        in_threads(sum_part, len(values))
        sums = parts.sum(0)
        sums[1] *= inverse
        shift_gradient, gain_gradient = sums.to(a.dtype)
        if dist.is_initialized() and dist.get_world_size() > 1:
            dist.all_reduce(sums)
        # Gradient through the mean and the variance: -(a / n) (sum(g) + z sum(g z)), where
        # z = (x - mean) * inverse: an affine function of x.
        slope = -a / ctx.count * inverse * sums[1]
        offset = -a / ctx.count * sums[0] - slope * mean
        through = slope.to(a.dtype).numpy(), offset.to(a.dtype).numpy()
        pooled_through = through if ctx.pool is None else (np.zeros_like(affine[0]),) * 2
        direct = torch.empty_like(pooled, memory_format=torch.channels_last)
        out = as_rows(direct)

        def differentiate(part: slice, _: int) -> None:
            input_gradient(given[part], values[part], *affine, *pooled_through, out[part])

        in_threads(differentiate, len(values))
        if ctx.pool is not None:
            direct = _unpool(direct, x, ctx.pool, places)
            direct = direct.contiguous(memory_format=torch.channels_last)
            all_values, whole = as_rows(x), as_rows(direct)
            in_threads(
                lambda part, _: add_affine(all_values[part], *through, whole[part]), len(whole)
            )
        return direct, gain_gradient, shift_gradient, None, None, None


def _unpool(gradient: Tensor, x: Tensor, pool: dict[str, Any], places: Tensor) -> Tensor:
    out: Tensor = native.max_pool2d_with_indices_backward(
        gradient,
        x,
        pool["kernel_size"],
        pool["stride"],
        pool["padding"],
        [1, 1],
        pool["ceil_mode"],
        places,
    )
    return out


def norm_pool_relu(x: Tensor, sign: Tensor, norm: nn.BatchNorm2d, pool: Pool | None) -> Tensor:
    """Compute batch normalisation, max pooling (none if `pool` is None) and ReLU of `x`
    (B, C, H, W); the result is (B, C, h, w).

    `x` is the output of the convolution times `sign` (C,), the sign of the normalisation's gain
    `norm.weight`. The running statistics of `norm` are updated as torch does.
    """
    with torch.no_grad():
        mean, variance, count = statistics(x)
        momentum = norm.momentum or 0.0
        assert norm.running_mean is not None
        assert norm.running_var is not None
        assert norm.num_batches_tracked is not None
        norm.running_mean.lerp_(mean * sign, momentum)
        norm.running_var.lerp_(variance * (count / max(count - 1, 1)), momentum)
        norm.num_batches_tracked += 1
    out: Tensor = _NormPoolRelu.apply(
        x, norm.weight * sign, norm.bias, (mean, variance, count), norm.eps, pool
    )
    return out

"""Fused batch normalisation, max pooling and ReLU in training.

max(relu(a x + b)) = relu(a max(x) + b) for a >= 0, so pooling comes first and saves three quarters
of the work; where a is negative, the caller negates the filter and a. Statistics are those of the
batch over all processes (Ioffe and Szegedy 2015, algorithm 1).
"""

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.functional import batch_norm, max_pool2d, relu

from mtlnet.model.architecture import Pool, same_padding

native = torch.ops.aten


def pool_arguments(height: int, width: int, pool: Pool) -> dict[str, Any]:
    """Arguments of `max_pool2d` for SAME padding: `padding` before, `ceil_mode` after.

    Before a ReLU it equals the zero padding of `mtlnet.model.network`.
    """
    before = [same_padding(size, pool.kernel, pool.stride)[1] for size in (height, width)]
    return {
        "kernel_size": [pool.kernel] * 2,
        "stride": [pool.stride] * 2,
        "padding": before,
        "ceil_mode": True,
    }


def statistics(x: Tensor) -> tuple[Tensor, Tensor, int]:
    """Mean (C,), biased variance (C,) and count of values x (B, C, H, W), over all processes.

    float32 for x in bf16.
    """
    unused = torch.zeros(2, x.shape[1], dtype=torch.promote_types(x.dtype, torch.float32))
    mean, variance = native.batch_norm_update_stats(x, unused[0], unused[1], 0.0)
    count = x.numel() // x.shape[1]
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return mean, variance, count
    world = dist.get_world_size()  # each process has the same number of images
    moments = torch.stack([mean, variance + mean.square()]).double()
    dist.all_reduce(moments)
    moments /= world
    mean = moments[0]
    return mean.to(unused), (moments[1] - mean.square()).to(unused), count * world


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
        ctx.eps, ctx.pool = eps, None
        pooled, places = x, None
        if pool is not None:
            ctx.pool = pool_arguments(x.shape[2], x.shape[3], pool)
            pooled, places = max_pool2d(x, **ctx.pool, return_indices=True)
        y = relu(batch_norm(pooled, mean, variance, gain, shift, False, 0.0, eps))
        ctx.save_for_backward(x, pooled, y, gain, mean, variance, places)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None, None]:
        x, pooled, y, gain, mean, variance, places = ctx.saved_tensors
        relu_gradient = native.threshold_backward(gradients[0], y, 0)
        deviation = torch.sqrt(variance + ctx.eps)
        direct, gain_gradient, shift_gradient = native.native_batch_norm_backward(
            relu_gradient,
            pooled,
            gain,
            mean,
            variance,
            None,
            None,
            False,
            ctx.eps,
            [True, True, True],
        )
        if ctx.pool is not None:
            direct = _unpool(direct, x, ctx.pool, places)
        sums = torch.stack([gain_gradient, shift_gradient])
        if dist.is_initialized() and dist.get_world_size() > 1:
            dist.all_reduce(sums)
        # Gradient through the mean and the variance: -(a / n) (sum(g) + z sum(g z)), where
        # a = gain / deviation and z = (x - mean) / deviation: an affine function of x.
        a = -gain / deviation / ctx.count
        through = batch_norm(x, mean, variance, a * sums[0], a * sums[1], False, 0.0, ctx.eps)
        return direct.add_(through), gain_gradient, shift_gradient, None, None, None


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
    """Batch normalisation, max pooling and ReLU of x (B, C, H, W).

    x is the convolution's output times `sign` (C,), the sign of the normalisation's gain. Updates
    the running statistics of `norm` like torch, or uses them if `norm` is in evaluation mode.
    """
    if not norm.training:
        return _frozen_norm_pool_relu(x, sign, norm, pool)
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


def _frozen_norm_pool_relu(
    x: Tensor, sign: Tensor, norm: nn.BatchNorm2d, pool: Pool | None
) -> Tensor:
    assert norm.running_mean is not None
    pooled = x if pool is None else max_pool2d(x, **pool_arguments(x.shape[2], x.shape[3], pool))
    mean, gain = norm.running_mean * sign, norm.weight * sign
    return relu(batch_norm(pooled, mean, norm.running_var, gain, norm.bias, False, 0.0, norm.eps))

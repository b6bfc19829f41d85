"""Convolution of a small feature map as one matrix product (im2col).

The last three convolutions have inputs of at most 7 x 9 pixels and most of the weights. There a
CPU's convolution spends most of its time on reordering weights; im2col, which uses the weights as
they are stored, takes a sixth of the time.
"""

from typing import Any

import torch
from torch import Tensor

from mtlnet.model.architecture import same_padding


class _Im2colConvolution(torch.autograd.Function):
    """x (B, H, W, C), weight (F, k, k, C) -> (B, h, w, F), SAME padding."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, stride: int) -> Tensor:
        count, height, width, channels = x.shape
        filters, k = weight.shape[:2]
        out_h, top, bottom = same_padding(height, k, stride)
        out_w, left, right = same_padding(width, k, stride)
        padded = x.new_zeros((count, height + top + bottom, width + left + right, channels))
        padded[:, top : top + height, left : left + width] = x
        windows = padded.unfold(1, k, stride).unfold(2, k, stride)  # (B, h, w, C, k, k)
        columns = windows.permute(0, 1, 2, 4, 5, 3).reshape(count * out_h * out_w, -1)
        ctx.save_for_backward(columns, weight)
        ctx.shape, ctx.padded, ctx.stride, ctx.corner = x.shape, padded.shape, stride, (top, left)
        return (columns @ weight.reshape(filters, -1).t()).view(count, out_h, out_w, filters)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        columns, weight = ctx.saved_tensors
        gradient = gradients[0]
        count, out_h, out_w, filters = gradient.shape
        k, stride, (top, left) = weight.shape[1], ctx.stride, ctx.corner
        flat = gradient.reshape(-1, filters)
        weight_gradient = (flat.t() @ columns).view(weight.shape)
        parts = (flat @ weight.reshape(filters, -1)).view(count, out_h, out_w, k, k, -1)
        padded = gradient.new_zeros(ctx.padded)
        for i in range(k):
            for j in range(k):
                rows = slice(i, i + stride * (out_h - 1) + 1, stride)
                cells = slice(j, j + stride * (out_w - 1) + 1, stride)
                padded[:, rows, cells] += parts[:, :, :, i, j]
        _, height, width, _ = ctx.shape
        return padded[:, top : top + height, left : left + width], weight_gradient, None


def im2col_convolution(x: Tensor, weight: Tensor, stride: int) -> Tensor:
    """`x` (B, C, H, W) and `weight` (F, C, k, k), both channels-last -> (B, F, h, w), SAME."""
    out_nhwc = _Im2colConvolution.apply(x.permute(0, 2, 3, 1), weight.permute(0, 2, 3, 1), stride)
    out: Tensor = out_nhwc.permute(0, 3, 1, 2)
    return out

"""Computes the first convolution, and convolutions of small feature maps, in forms that are fast on
a CPU.

Space to depth turns each block of 4 x 4 pixels into one pixel with 48 channels (row, column,
colour). The first layer of `mtl` (11 x 11, stride 4, 3 colours) then becomes a 3 x 3 convolution
with stride 1: with SAME padding a window starts 4 rows and 3 columns before its block, so 3 x 3
blocks contain the window, and the kernel is padded to 12 x 12. CPUs compute this form three times
as fast as the form with 3 channels. The first layer of `grid` (12 x 12, padding 4) needs no padding
of its kernel.

The last three convolutions of `mtl` have inputs of at most 7 x 9 pixels and most of the weights. A
CPU spends most of the time of these convolutions on reordering weights. One matrix product (im2col)
uses the weights as they are stored and takes a sixth of the time.
"""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from mtlnet.architecture import same_padding
from mtlnet.model.cpu_kernels.elementwise import as_rows, centre, in_threads
from mtlnet.model.cpu_kernels.winograd import winograd_convolution

BLOCK = 4
ROW_BYTES = 12  # bytes of one row of a block: four pixels of three colours
COLOUR_OFFSET = 127.5
"""The colour that is normalised to 0. bf16 holds it and its differences from all uint8 colours
exactly."""


def space_to_depth(images: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert images uint8 (B, H, W, 3) to one pixel with 48 channels for each block of 4 x 4 px:
    (B, 48, ceil(H / 4), W / 4) of type `dtype`, channels-last.

    Values are colours minus 127.5; rows below the image are 0. W must be a multiple of 4.
    """
    count, height, width, _ = images.shape
    rows, columns, rest = -(-height // BLOCK), width // BLOCK, height % BLOCK
    words = images.reshape(count, height, width * 3).view(torch.int32)  # copies 4 bytes at a time
    blocks = torch.empty((count, rows, columns, BLOCK, ROW_BYTES // 4), dtype=torch.int32)
    whole = height - rest
    blocks[:, : whole // BLOCK] = (
        words[:, :whole].view(count, whole // BLOCK, BLOCK, columns, ROW_BYTES // 4).transpose(2, 3)
    )
    if rest:
        last = words[:, whole:].view(count, rest, columns, ROW_BYTES // 4)
        blocks[:, -1, :, :rest] = last.transpose(1, 2)
    x = torch.empty((count, rows, columns, BLOCK * ROW_BYTES), dtype=dtype).permute(0, 3, 1, 2)
    pixels = blocks.view(torch.uint8).view(-1, BLOCK * ROW_BYTES).numpy()
    values = as_rows(x)
    in_threads(lambda part, _: centre(pixels[part], COLOUR_OFFSET, values[part]), len(values))
    if rest:
        x[:, rest * ROW_BYTES :, -1] = 0
    return x


def space_to_depth_convolution(
    x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype
) -> Tensor:
    """Compute a convolution with stride 4 of normalised images from `x` (B, 48, h, w), the result
    of `space_to_depth`; the result is (B, F, h, w) in `dtype`. `weight` is (F, 3, 11, 11) or
    (F, 3, 12, 12), for colours in [-1, 1]; `bias` is (F,)."""
    short = 3 * BLOCK - weight.shape[2]
    kernel = pad(weight * (1 / COLOUR_OFFSET), (short, 0, 0, short))
    filters = len(weight)
    kernel = kernel.view(filters, 3, 3, BLOCK, 3, BLOCK).permute(0, 3, 5, 1, 2, 4)
    kernel = kernel.reshape(filters, BLOCK * ROW_BYTES, 3, 3).to(dtype)
    kernel = kernel.contiguous(memory_format=torch.channels_last)
    return convolution_3x3(x, kernel, None if bias is None else bias.to(dtype))


def convolution_3x3(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Compute the convolution with padding 1 and stride 1 of `x` (B, C, H, W) by `weight`
    (F, C, 3, 3), plus `bias` (F,), all channels-last and of one type; the result is (B, F, H, W).

    The gradients are computed by Winograd's algorithm, except in bf16: processors with bf16
    instructions multiply so fast that the algorithm's transforms would take longer.
    """
    if x.dtype == torch.bfloat16:
        return conv2d(x, weight, bias, padding=1)
    return winograd_convolution(x, weight, bias)


class _Im2colConvolution(torch.autograd.Function):
    """Convolution with SAME padding: x (B, H, W, C), weight (F, k, k, C) -> (B, h, w, F)."""

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
    """Compute the convolution with SAME padding of `x` (B, C, H, W) by `weight` (F, C, k, k), both
    channels-last; the result is (B, F, ceil(H / stride), ceil(W / stride))."""
    out_nhwc = _Im2colConvolution.apply(x.permute(0, 2, 3, 1), weight.permute(0, 2, 3, 1), stride)
    out: Tensor = out_nhwc.permute(0, 3, 1, 2)
    return out

"""The first convolution, 11 x 11 with stride 4 on 3 colours, as 3 x 3 with stride 1 on 48 channels.

Space to depth: a block of 4 x 4 pixels becomes one pixel of 48 channels (row, column, colour). SAME
padding starts a window 4 rows and 3 columns before its block, so 3 x 3 blocks contain it; the
kernel is padded to 12 x 12. CPUs compute this three times as fast as with 3 channels. A convolution
of 12 x 12 with four zeros around the image has that form already.
"""

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

BLOCK = 4
ROW_BYTES = 12  # of one row of a block: four pixels of three colours
COLOUR_OFFSET = 127.5
"""The uint8 value that is normalised to 0; exact in bf16, as are all colours minus it."""


def space_to_depth(images: Tensor, dtype: torch.dtype) -> Tensor:
    """uint8 (B, H, W, 3) -> (B, 48, ceil(H / 4), W / 4) channels-last.

    Values are colours minus `COLOUR_OFFSET`. Rows below the image are 0. W must be a multiple of 4.
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
    x = blocks.view(torch.uint8).to(dtype).sub_(COLOUR_OFFSET)
    if rest:
        x[:, -1, :, rest:] = 0
    return x.view(count, rows, columns, BLOCK * ROW_BYTES).permute(0, 3, 1, 2)


def space_to_depth_convolution(
    x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype
) -> Tensor:
    """The convolution with `weight` (F, 3, 11, 11), or 12 x 12, of x (B, 48, h, w)."""
    short = 3 * BLOCK - weight.shape[2]
    kernel = pad(weight * (1 / COLOUR_OFFSET), (short, 0, 0, short))
    filters = len(weight)
    kernel = kernel.view(filters, 3, 3, BLOCK, 3, BLOCK).permute(0, 3, 5, 1, 2, 4)
    kernel = kernel.reshape(filters, BLOCK * ROW_BYTES, 3, 3).to(dtype)
    kernel = kernel.contiguous(memory_format=torch.channels_last)
    return conv2d(x, kernel, None if bias is None else bias.to(dtype), padding=1)

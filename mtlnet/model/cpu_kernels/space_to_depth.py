"""The first convolution, 11 x 11 with stride 4 on 3 colours, as 3 x 3 with stride 1 on 48 channels.

A 4 x 4 block of pixels becomes one place of 48 channels (row, column, colour). SAME padding starts
a window 4 rows and 3 columns before its block, so three by three blocks hold it: the kernel is
padded to 12 x 12 and the sums are those of the paper's layer. CPUs multiply 48 channels three
times as fast as 3.
"""

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

BLOCK = 4
BYTES = 12  # a row of a block: four pixels of three colours
MIDDLE = 127.5
"""What a colour of 0 after normalisation is in uint8; exact in bf16, as is every colour less it."""


def to_blocks(images: Tensor, dtype: torch.dtype) -> Tensor:
    """uint8 (B, H, W, 3) -> (B, 48, ceil(H / 4), W / 4) channels-last: colours less `MIDDLE`.

    Rows below the image are 0. W must be a multiple of 4.
    """
    count, height, width, _ = images.shape
    rows, columns, rest = -(-height // BLOCK), width // BLOCK, height % BLOCK
    words = images.reshape(count, height, width * 3).view(torch.int32)  # copies 4 bytes at a time
    blocks = torch.empty((count, rows, columns, BLOCK, BYTES // 4), dtype=torch.int32)
    whole = height - rest
    blocks[:, : whole // BLOCK] = (
        words[:, :whole].view(count, whole // BLOCK, BLOCK, columns, BYTES // 4).transpose(2, 3)
    )
    if rest:
        last = words[:, whole:].view(count, rest, columns, BYTES // 4)
        blocks[:, -1, :, :rest] = last.transpose(1, 2)
    x = blocks.view(torch.uint8).to(dtype).sub_(MIDDLE)
    if rest:
        x[:, -1, :, rest:] = 0
    return x.view(count, rows, columns, BLOCK * BYTES).permute(0, 3, 1, 2)


def block_convolution(x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    """The layer with `weight` (F, 3, 11, 11) on blocks (B, 48, h, w) -> (B, F, h, w)."""
    kernel = pad(weight * (1 / MIDDLE), (1, 0, 0, 1))
    filters = len(weight)
    kernel = kernel.view(filters, 3, 3, BLOCK, 3, BLOCK).permute(0, 3, 5, 1, 2, 4)
    kernel = kernel.reshape(filters, BLOCK * BYTES, 3, 3).to(dtype)
    kernel = kernel.contiguous(memory_format=torch.channels_last)
    return conv2d(x, kernel, None if bias is None else bias.to(dtype), padding=1)

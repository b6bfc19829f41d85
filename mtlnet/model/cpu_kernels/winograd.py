"""Computes the gradients of 3 x 3 convolutions on a CPU with fewer multiplications.

The algorithm is F(3 x 3, 3 x 3) of Lavin and Gray 2015 ("Fast Algorithms for Convolutional Neural
Networks"), after Winograd. It divides the output into tiles of 3 x 3 pixels. A tile is Aᵀ M A with
M = (G g Gᵀ) ∘ (Bᵀ d B). Here g is the filter, d is the window of the input on which the tile
depends, 5 x 5 pixels, and ∘ multiplies element by element. M is summed over the channels of the
input, so each of its 25 elements is a matrix product. For each pair of channels a tile takes 25
multiplications instead of 81.

The gradients are the derivatives of these formulas: dM = A dY Aᵀ, dg = Gᵀ ((Bᵀ d B) ∘ dM) G summed
over the tiles, and dd = B ((G g Gᵀ) ∘ dM) Bᵀ summed where windows overlap. The forward pass is
torch's convolution: computed by tiles it would take as long.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, pad

from mtlnet.model.cpu_kernels.elementwise import in_threads
from runtime.jit import compiled_for_threads

TILE, WINDOW = 3, 5
"""Sides of a tile of the output and of its window in the input, pixels."""
G = (
    (1 / 2, 0, 0),
    (-1 / 2, -1 / 2, -1 / 2),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 6, 1 / 3, 2 / 3),
    (0, 0, 1),
)
"""Matrix (5, 3) that transforms filters. Its rows belong to the points 0, 1, -1, 2 and infinity, at
which the polynomials of Winograd's algorithm are evaluated."""
IMAGES = 16
"""Number of images that are processed together. The tiles of more images do not fit into the cache.
"""
TWO, THREE, FOUR = np.float32(2), np.float32(3), np.float32(4)
"""float32 factors, because numba multiplies a float32 and an integer in float64."""

Values = NDArray[Any]
Gradients = tuple[Tensor | None, Tensor | None, Tensor | None]


def winograd_convolution(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Compute the convolution with padding 1 and stride 1 of `x` (B, C, H, W) by `weight`
    (F, C, 3, 3), plus `bias` (F,); the result is (B, F, H, W). All are float32 or float64, and `x`
    and `weight` are channels-last. Winograd's algorithm computes the gradients."""
    out: Tensor = _Convolution.apply(x, weight, bias)
    return out


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        return conv2d(x, weight, bias, padding=1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Gradients:
        x, weight = ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        dy = gradients[0]
        dx, dweight = _gradients(x, weight, dy, of_x=of_x, of_weight=of_weight)
        return dx, dweight, dy.sum((0, 2, 3)) if of_bias else None


def _gradients(
    x: Tensor, weight: Tensor, dy: Tensor, *, of_x: bool, of_weight: bool
) -> tuple[Tensor | None, Tensor | None]:
    """The gradients of x (B, C, H, W) and weight (F, C, 3, 3) for the gradient `dy` (B, F, H, W) of
    the convolution, both channels-last; None for a gradient that is not asked for."""
    (count, channels, height, width), filters = x.shape, len(weight)
    down, across = -(-height // TILE), -(-width // TILE)
    below, right = down * TILE - height, across * TILE - width
    tiles = _channels_last(pad(dy, (0, right, 0, below)))
    windows = _channels_last(pad(x, (1, right + 1, 1, below + 1)) if of_weight else x)
    g = weight.new_tensor(G)
    u = torch.einsum("ik,fckl,jl->ijfc", g, weight, g).flatten(0, 1).contiguous()
    du = torch.zeros_like(u)
    dx = x.new_zeros((count, down * TILE + 2, across * TILE + 2, channels) if of_x else 0)
    for first in range(0, count, IMAGES):
        images = min(IMAGES, count - first)
        shape = (len(u), images, down * across)
        dm = x.new_empty((*shape, filters))
        _in_threads(_transform_tiles, tiles[first:], dm.numpy(), images)
        if of_weight:
            v = x.new_empty((*shape, channels))
            _in_threads(_transform_windows, windows[first:], v.numpy(), images)
            du.baddbmm_(dm.flatten(1, 2).transpose(1, 2), v.flatten(1, 2))
        if of_x:
            dv = torch.bmm(dm.flatten(1, 2), u).view(*shape, channels)
            _in_threads(_add_windows, dx[first:].numpy(), dv.numpy(), images)
    found = torch.einsum("ik,ijfc,jl->fklc", g, du.view(WINDOW, WINDOW, filters, channels), g)
    inside = dx[:, 1 : height + 1, 1 : width + 1].contiguous() if of_x else dx
    return (
        inside.permute(0, 3, 1, 2) if of_x else None,
        found.contiguous().permute(0, 3, 1, 2) if of_weight else None,
    )


def _channels_last(x: Tensor) -> Values:
    """The values of `x` (B, C, H, W) as an array (B, H, W, C)."""
    values: Values = x.permute(0, 2, 3, 1).contiguous().numpy()
    return values


def _in_threads(transform: Any, pixels: Values, products: Values, images: int) -> None:
    in_threads(lambda part, _: transform(pixels, part.start, part.stop, products), images)


@compiled_for_threads
def _times_a(y0: Any, y1: Any, y2: Any) -> Any:
    """The product of A and a vector (3,)."""
    ends = y0 + y2
    return y0, ends + y1, ends - y1, y0 + TWO * y1 + FOUR * y2, y2


@compiled_for_threads
def _times_b(v0: Any, v1: Any, v2: Any, v3: Any, v4: Any) -> Any:
    """The product of B and a vector (5,)."""
    second = TWO * (v2 - v1 + v4) - v0 - v3
    third = v1 + THREE * v2 + v4 + TWO * v0
    return TWO * v0, second, -third, v0 + v1 + v2 + v3 - TWO * v4, v4


@compiled_for_threads
def _times_b_transposed(d0: Any, d1: Any, d2: Any, d3: Any, d4: Any) -> Any:
    """The product of Bᵀ and a vector (5,)."""
    slope = d3 - d1
    first = TWO * (d0 - d2) + slope
    return first, d3 - d2 - TWO * d1, d3 - THREE * d2 + TWO * d1, slope, d4 - d2 - TWO * slope


@compiled_for_threads
def _set_column(half: Values, j: int, c: int, values: Any) -> None:
    """Set channel `c` of column `j` of `half` (5, W, C) to five values."""
    half[0, j, c] = values[0]
    half[1, j, c] = values[1]
    half[2, j, c] = values[2]
    half[3, j, c] = values[3]
    half[4, j, c] = values[4]


@compiled_for_threads
def _set_products(v: Values, k: int, n: int, t: int, c: int, values: Any) -> None:
    """Set channel `c` of tile `t` of image `n` in the five elements from `k` on of `v`
    (25, N, T, C) to five values."""
    v[k, n, t, c] = values[0]
    v[k + 1, n, t, c] = values[1]
    v[k + 2, n, t, c] = values[2]
    v[k + 3, n, t, c] = values[3]
    v[k + 4, n, t, c] = values[4]


# The transforms process the images from `first` up to `last`. `half` has a tile or window of which
# the columns are transformed, but not yet the rows.


@compiled_for_threads
def _transform_windows(x: Values, first: int, last: int, v: Values) -> None:
    """Set `v` (25, N, T, C) to Bᵀ d B of the T windows of the images in `x` (N, h, w, C). Windows
    start at every third row and column."""
    channels, across = x.shape[3], (x.shape[2] - 2) // TILE
    half = np.empty((WINDOW, WINDOW, channels), x.dtype)
    for n in range(first, last):
        for t in range(v.shape[2]):
            top, left = t // across * TILE, t % across * TILE
            for j in range(WINDOW):
                x0, x1, x2 = x[n, top, left + j], x[n, top + 1, left + j], x[n, top + 2, left + j]
                x3, x4 = x[n, top + 3, left + j], x[n, top + 4, left + j]
                for c in range(channels):
                    d = _times_b_transposed(x0[c], x1[c], x2[c], x3[c], x4[c])
                    _set_column(half, j, c, d)
            for i in range(WINDOW):
                row, k = half[i], i * WINDOW
                for c in range(channels):
                    d = _times_b_transposed(row[0, c], row[1, c], row[2, c], row[3, c], row[4, c])
                    _set_products(v, k, n, t, c, d)


@compiled_for_threads
def _transform_tiles(y: Values, first: int, last: int, m: Values) -> None:
    """Set `m` (25, N, T, F) to A dY Aᵀ of the T tiles of the images in `y` (N, h, w, F)."""
    filters, across = y.shape[3], y.shape[2] // TILE
    half = np.empty((WINDOW, TILE, filters), y.dtype)
    for n in range(first, last):
        for t in range(m.shape[2]):
            top, left = t // across * TILE, t % across * TILE
            for j in range(TILE):
                y0, y1, y2 = y[n, top, left + j], y[n, top + 1, left + j], y[n, top + 2, left + j]
                for c in range(filters):
                    _set_column(half, j, c, _times_a(y0[c], y1[c], y2[c]))
            for i in range(WINDOW):
                row, k = half[i], i * WINDOW
                for c in range(filters):
                    _set_products(m, k, n, t, c, _times_a(row[0, c], row[1, c], row[2, c]))


@compiled_for_threads
def _add_windows(x: Values, first: int, last: int, v: Values) -> None:
    """Add B dV Bᵀ of the T windows of each image to `x` (N, h, w, C), for `v` (25, N, T, C)."""
    channels, across = x.shape[3], (x.shape[2] - 2) // TILE
    half = np.empty((WINDOW, WINDOW, channels), x.dtype)
    for n in range(first, last):
        for t in range(v.shape[2]):
            top, left = t // across * TILE, t % across * TILE
            for j in range(WINDOW):
                v0, v1, v2 = v[j, n, t], v[WINDOW + j, n, t], v[2 * WINDOW + j, n, t]
                v3, v4 = v[3 * WINDOW + j, n, t], v[4 * WINDOW + j, n, t]
                for c in range(channels):
                    _set_column(half, j, c, _times_b(v0[c], v1[c], v2[c], v3[c], v4[c]))
            for i in range(WINDOW):
                row, pixels = half[i], x[n, top + i]
                for c in range(channels):
                    b0, b1, b2, b3, b4 = _times_b(
                        row[0, c], row[1, c], row[2, c], row[3, c], row[4, c]
                    )
                    pixels[left, c] += b0
                    pixels[left + 1, c] += b1
                    pixels[left + 2, c] += b2
                    pixels[left + 3, c] += b3
                    pixels[left + 4, c] += b4

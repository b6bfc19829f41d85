"""Compiled loops over channels-last values (N, C), for the network's input, batch normalisation and
ReLU.

torch reads bf16 values in channels-last order more often and takes several times as long. Values
are bf16 (stored as uint16), float32 or float64. Parameters of a channel (C,) and computed values
are float32, or float64 if the values are float64. Sums are computed in the parameters' type within
blocks of 256 rows, and in float64 over the blocks. `in_threads` runs a loop on as many threads as
torch uses.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor

from runtime.jit import compiled_for_threads

BLOCK_ROWS = 256
BF16 = types.uint16
BF16_SHIFT = 16  # bf16 is the upper half of a float32

Values = NDArray[Any]
Sums = NDArray[np.float64]


def _int32(value: int) -> Any:
    return ir.Constant(ir.IntType(32), value)


def _typed_widen(typing_context: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if signature.args[0] != BF16:
            return arguments[0]
        bits = builder.zext(arguments[0], ir.IntType(32))
        return builder.bitcast(builder.shl(bits, _int32(BF16_SHIFT)), ir.FloatType())

    return (types.float32 if value == BF16 else value)(value), build


def _typed_narrow(typing_context: Any, value: Any, like: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if signature.args[1] != BF16:
            return arguments[0]
        bits = builder.bitcast(arguments[0], ir.IntType(32))  # rounded to nearest, ties to even
        odd = builder.and_(builder.lshr(bits, _int32(BF16_SHIFT)), _int32(1))
        rounded = builder.add(builder.add(bits, odd), _int32((1 << (BF16_SHIFT - 1)) - 1))
        return builder.trunc(builder.lshr(rounded, _int32(BF16_SHIFT)), ir.IntType(16))

    return like(types.float32 if like == BF16 else like, like), build


widen: Any = intrinsic(_typed_widen)
"""`widen(value)`: a stored bf16 value converted to float32; values of other types unchanged."""
narrow: Any = intrinsic(_typed_narrow)
"""`narrow(value, like)`: a computed value converted to the type of the stored value `like`."""


@compiled_for_threads
def add_moments(x: Values, origin: Values, total: Sums, squares: Sums) -> None:
    """Add the sums over the rows of x - `origin`, and of its squares, to `total` and `squares`.

    `x` is (N, C); `origin`, `total` and `squares` are (C,).
    """
    rows, channels = x.shape
    sums, products = np.zeros_like(origin), np.zeros_like(origin)
    for start in range(0, rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, rows)
        sums[:] = 0
        products[:] = 0
        fours = stop - (stop - start) % 4
        for n in range(start, fours, 4):
            for c in range(channels):
                d0, d1 = widen(x[n, c]) - origin[c], widen(x[n + 1, c]) - origin[c]
                d2, d3 = widen(x[n + 2, c]) - origin[c], widen(x[n + 3, c]) - origin[c]
                sums[c] += (d0 + d1) + (d2 + d3)
                products[c] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)
        for n in range(fours, stop):
            for c in range(channels):
                d = widen(x[n, c]) - origin[c]
                sums[c] += d
                products[c] += d * d
        total += sums
        squares += products


@compiled_for_threads
def affine_relu(x: Values, a: Values, b: Values, out: Values) -> None:
    """Set `out` (N, C) to relu(a x + b) for `x` (N, C), `a` and `b` (C,)."""
    zero = a.dtype.type(0)
    for n in range(x.shape[0]):
        for c in range(x.shape[1]):
            y = widen(x[n, c]) * a[c] + b[c]
            out[n, c] = narrow(y if y > zero else zero, out[n, c])


@compiled_for_threads
def add_gradient_sums(
    gradient: Values,
    x: Values,
    a: Values,
    b: Values,
    mean: Values,
    sums: Sums,
    products: Sums,
) -> None:
    """Add the sums over the rows that the gradient of y = relu(a x + b) needs to `sums` and
    `products` (C,).

    `gradient` (N, C) is the gradient with respect to y, and g is the gradient with respect to a x +
    b: `gradient` where y > 0, else 0. The function adds the sum of g over the rows to `sums`, and
    the sum of g (x - mean) to `products`. `x` is (N, C); `a`, `b` and `mean` are (C,).
    """
    zero = a.dtype.type(0)
    block_sums, block_products = np.zeros_like(a), np.zeros_like(a)
    for start in range(0, x.shape[0], BLOCK_ROWS):
        block_sums[:] = 0
        block_products[:] = 0
        for n in range(start, min(start + BLOCK_ROWS, x.shape[0])):
            for c in range(x.shape[1]):
                value, g = widen(x[n, c]), widen(gradient[n, c])
                g = g if value * a[c] + b[c] > zero else zero
                block_sums[c] += g
                block_products[c] += g * (value - mean[c])
        sums += block_sums
        products += block_products


@compiled_for_threads
def input_gradient(
    gradient: Values, x: Values, a: Values, b: Values, slope: Values, offset: Values, out: Values
) -> None:
    """Set `out` (N, C) to a g + slope x + offset. Here g is `gradient` (N, C) where a x + b > 0,
    else 0; `x` is (N, C), all other arguments are (C,)."""
    zero = a.dtype.type(0)
    for n in range(x.shape[0]):
        for c in range(x.shape[1]):
            value, g = widen(x[n, c]), widen(gradient[n, c])
            g = g if value * a[c] + b[c] > zero else zero
            out[n, c] = narrow(g * a[c] + (value * slope[c] + offset[c]), out[n, c])


@compiled_for_threads
def add_affine(x: Values, slope: Values, offset: Values, out: Values) -> None:
    """Add slope x + offset to `out` (N, C), for `x` (N, C), `slope` and `offset` (C,)."""
    for n in range(x.shape[0]):
        for c in range(x.shape[1]):
            sum_ = widen(out[n, c]) + (widen(x[n, c]) * slope[c] + offset[c])
            out[n, c] = narrow(sum_, out[n, c])


@compiled_for_threads
def centre(pixels: NDArray[np.uint8], offset: float, out: Values) -> None:
    """Set `out` (N, C) to `pixels` (N, C) - `offset`."""
    for n in range(pixels.shape[0]):
        for c in range(pixels.shape[1]):
            out[n, c] = narrow(np.float32(pixels[n, c]) - np.float32(offset), out[n, c])


def as_rows(x: Tensor) -> Values:
    """Return the values of `x` (B, C, H, W) as an array (B * H * W, C), with bf16 stored as uint16.

    The array shares the memory of `x` if `x` is channels-last.
    """
    last = x.permute(0, 2, 3, 1).contiguous()
    stored = last.view(torch.uint16) if x.dtype == torch.bfloat16 else last
    return stored.view(-1, x.shape[1]).numpy()


@lru_cache(1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "elementwise")


def in_threads(work: Callable[[slice, int], None], rows: int) -> None:
    """Divide `rows` rows into as many parts as torch uses threads, and call `work(part, number)`
    for each part on its own thread. `part` is the slice of the rows, `number` counts the parts from
    0.

    Returns when all parts are done. Raises the exceptions of `work`.
    """
    parts = part_count()
    bounds = [rows * number // parts for number in range(parts + 1)]
    slices = [slice(low, high) for low, high in pairwise(bounds)]
    others = [
        _pool(parts).submit(work, part, number) for number, part in enumerate(slices[1:], start=1)
    ]
    try:
        work(slices[0], 0)
    finally:
        for other in others:
            other.result()


def part_count() -> int:
    """Return the number of threads that torch uses."""
    return torch.get_num_threads()

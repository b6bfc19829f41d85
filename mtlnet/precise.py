"""Layers of an OpenVINO graph that are computed in float32 where the rest is in bf16.

OpenVINO rounds what a MatMul gives to bf16, in steps of 0.004 near 1: 0.025 m and 0.005 rad.
It leaves the element-wise operations that end a graph alone.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtlnet.doubt import (
    BANDS,
    COLUMNS_OF_CELLS,
    MIDDLE_BANDS,
    MIDDLE_COLUMNS,
    ROWS_OF_CELLS,
    SMALLEST,
    Doubt,
)


def precise_product(ops: Any, x: Any, weight: NDArray[np.float32]) -> Any:
    """x (1, F) times weight (N, F), transposed: (1, N)."""
    # In two dimensions: three are laid out as an image's channels, and back for the sum.
    sums = ops.reduce_sum(ops.multiply(x, weight), np.array([1]))
    return ops.unsqueeze(sums, np.array([0]))


def precise_linear(ops: Any, x: Any, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Any:
    """The linear layer of these weights (N, F) and (N,) on x (1, F): (1, N)."""
    return ops.add(precise_product(ops, x, weight), bias[None])


def doubt_outputs(ops: Any, x: Any, pixels: Any, doubt: Doubt) -> list[Any]:
    """`Doubt.assess` of the last shared features x (1, F) and pixels (1, 3, H, W) in [-1, 1]."""
    z = ops.multiply(ops.subtract(x, doubt.centre[None]), doubt.scale[None])
    hidden = ops.relu(precise_linear(ops, z, doubt.hidden_weight, doubt.hidden_bias))
    logarithm = precise_linear(ops, hidden, doubt.weight, doubt.bias)
    limited = ops.minimum(ops.maximum(logarithm, doubt.low[None]), doubt.high[None])
    cells, middle = texture_graph(ops, pixels)
    along = precise_product(ops, ops.subtract(cells, doubt.usual[None]), doubt.directions)
    z = ops.multiply(ops.subtract(middle, doubt.aim_centre[None]), doubt.aim_scale[None])
    seen = ops.relu(precise_linear(ops, z, doubt.aim_hidden_weight, doubt.aim_hidden_bias))
    aim = precise_linear(ops, seen, doubt.aim_weight, doubt.aim_bias)
    strange = ops.reduce_sum(ops.multiply(along, along), np.array([1]), keep_dims=True)
    return [ops.exp(limited), ops.maximum(strange, ops.multiply(aim, aim))]


def texture_graph(ops: Any, pixels: Any) -> tuple[Any, Any]:
    """`mtlnet.doubt.texture` of pixels (1, 3, H, W): its cells (1, C) and its middle (1, M)."""
    _, _, height, width = pixels.shape
    grey = ops.reduce_mean(pixels, np.array([1]), keep_dims=True)
    planes = [pixels]
    for axis, size in ((3, width), (2, height)):
        ends = np.array([0] * axis + [1] + [0] * (3 - axis))
        longer = ops.pad(grey, np.zeros(4, int), ends, "edge")
        one, all_, by = np.array([1]), np.array([size + 1]), np.array([1])
        later = ops.slice(longer, one, all_, by, np.array([axis]))
        planes.append(ops.abs(ops.subtract(later, grey)))
    band = [height // (ROWS_OF_CELLS * BANDS), width // COLUMNS_OF_CELLS]
    narrow = [_means(ops, plane, band) for plane in planes]
    cells = [_means(ops, plane, [BANDS, 1]) for plane in narrow]
    first = np.array([MIDDLE_BANDS.start, MIDDLE_COLUMNS.start])
    last = np.array([MIDDLE_BANDS.stop, MIDDLE_COLUMNS.stop])
    steps, axes = np.array([1, 1]), np.array([2, 3])
    middle = [ops.slice(plane, first, last, steps, axes) for plane in narrow]
    return _flat(ops, cells), _flat(ops, middle)


def _means(ops: Any, plane: Any, cell: list[int]) -> Any:
    return ops.avg_pool(plane, cell, [0, 0], [0, 0], cell, False)


def _flat(ops: Any, planes: list[Any]) -> Any:
    """Colours as they are and roots of the differences, as one row."""
    colours, *others = planes
    roots = [ops.sqrt(ops.add(plane, np.float32(SMALLEST))) for plane in others]
    return ops.reshape(ops.concat([colours, *roots], 1), np.array([1, -1]), special_zero=False)

"""The uncertainty head and the out-of-distribution score as parts of an OpenVINO graph.

The same values as `mtlnet.inference.uncertainty`, in float32 even where the network is in bf16.
"""

from typing import Any

import numpy as np

from mtlnet.inference.graph_operations import (
    columns,
    count_values,
    is_of_one_image,
    linear_float32,
    part_of,
    sizes,
    without_last_axis,
)
from mtlnet.inference.uncertainty import (
    BANDS,
    CELL_COLUMNS,
    CELL_ROWS,
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    LIGHT_LIMIT,
    LIGHT_VALUES,
    SQRT_EPSILON,
    UncertaintyHead,
)


def uncertainty_outputs(ops: Any, x: Any, images: Any, head: UncertaintyHead) -> list[Any]:
    """Nodes of `UncertaintyHead.predict` for inputs x (B, X) and images uint8 (B, H, W, 3)."""
    cells, centre = texture_graph(ops, images)
    count = min(count_values(x), len(head.centre))
    z = _standardise(ops, columns(ops, x, 0, count), head, slice(0, count))
    if len(head.centre) > count:
        light = _standardise(ops, light_graph(ops, cells), head, slice(count, None))
        limit = np.float32(LIGHT_LIMIT)
        z = ops.concat([z, ops.minimum(ops.maximum(light, -limit), limit)], 1)
    hidden = ops.relu(linear_float32(ops, z, head.hidden_weight, head.hidden_bias))
    log_std = linear_float32(ops, hidden, head.weight, head.bias)
    limited = ops.minimum(ops.maximum(log_std, head.low[None]), head.high[None])
    deviation = ops.subtract(cells, head.texture_mean[None])
    projected = ops.matmul(deviation, ops.constant(head.texture_directions), False, True)
    z = ops.multiply(ops.subtract(centre, head.pitch_centre[None]), head.pitch_scale[None])
    hidden = ops.relu(linear_float32(ops, z, head.pitch_hidden_weight, head.pitch_hidden_bias))
    pitch = linear_float32(ops, hidden, head.pitch_weight, head.pitch_bias)
    distance = ops.reduce_sum(ops.multiply(projected, projected), np.array([1]), keep_dims=True)
    return [ops.exp(limited), ops.maximum(distance, ops.multiply(pitch, pitch))]


def _standardise(ops: Any, x: Any, head: UncertaintyHead, part: slice) -> Any:
    return ops.multiply(ops.subtract(x, head.centre[None, part]), head.scale[None, part])


def light_graph(ops: Any, cells: Any) -> Any:
    """Nodes of `mtlnet.inference.uncertainty.light_features`, (B, LIGHT_VALUES), for cells (B,
    C)."""
    shape = np.array([-1, LIGHT_VALUES, count_values(cells) // LIGHT_VALUES])
    halves = ops.reshape(cells, shape, special_zero=False)
    if not is_of_one_image(cells):
        return without_last_axis(ops, ops.reduce_mean(halves, np.array([2]), keep_dims=True))
    return ops.reduce_mean(halves, np.array([2]))


def texture_graph(ops: Any, images: Any) -> tuple[Any, Any]:
    """Nodes of `mtlnet.inference.uncertainty.texture_features`, (B, C) and (B, M), for images (B,
    H, W, 3)."""
    height, width, _ = sizes(images)
    colours = ops.transpose(images, np.array([0, 3, 1, 2]))  # on bytes: faster than on floats
    red, green, blue = (
        ops.convert(part_of(ops, colours, 1, number, number + 1), np.float32) for number in range(3)
    )
    total = ops.add(ops.add(red, green), blue)
    planes = [ops.convert(colours, np.float32)]
    for axis, size in ((3, width), (2, height)):
        ends = np.array([0] * axis + [1] + [0] * (3 - axis))
        longer = ops.pad(total, np.zeros(4, int), ends, "edge")
        following = part_of(ops, longer, axis, 1, size + 1)
        planes.append(ops.abs(ops.subtract(following, total)))
    colour, *differences = (_band_means(ops, plane) for plane in planes)
    narrow = [ops.subtract(ops.multiply(colour, np.float32(1 / 127.5)), np.float32(1))]
    narrow += [ops.multiply(plane, np.float32(1 / (3 * 127.5))) for plane in differences]
    cells = [_row_means(ops, plane, BANDS) for plane in narrow]
    first = np.array([CENTRE_BANDS.start, CENTRE_COLUMNS.start])
    last = np.array([CENTRE_BANDS.stop, CENTRE_COLUMNS.stop])
    steps, axes = np.array([1, 1]), np.array([2, 3])
    centre = [ops.slice(plane, first, last, steps, axes) for plane in narrow]
    return _flat(ops, cells), _flat(ops, centre)


def _band_means(ops: Any, planes: Any) -> Any:
    """Means (B, N, bands, columns) of planes (B, N, H, W)."""
    # Not by a pool, which first reorders planes in blocks of 16.
    count, height, width = sizes(planes)
    bands = CELL_ROWS * BANDS
    rows = _row_means(ops, planes, height // bands)
    shape = np.array([-1, count, bands, CELL_COLUMNS, width // CELL_COLUMNS])
    return ops.reduce_mean(ops.reshape(rows, shape, special_zero=False), np.array([4]))


def _row_means(ops: Any, planes: Any, rows: int) -> Any:
    """Means (B, N, H / rows, W) over groups of `rows` rows of planes (B, N, H, W)."""
    count, height, width = sizes(planes)
    shape = np.array([-1, count, height // rows, rows, width])
    return ops.reduce_mean(ops.reshape(planes, shape, special_zero=False), np.array([3]))


def _flat(ops: Any, planes: list[Any]) -> Any:
    """One row per image: the colours, then the square roots of the differences."""
    colours, *others = planes
    roots = [ops.sqrt(ops.add(plane, np.float32(SQRT_EPSILON))) for plane in others]
    together = ops.concat([colours, *roots], 1)
    return ops.reshape(together, np.array([-1, count_values(together)]), special_zero=False)

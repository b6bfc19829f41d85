"""Operations shared by the parts of a network's OpenVINO graph; B is the number of images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def sizes(x: Any) -> list[int]:
    """Sizes of the axes of a node's result, without the first axis (the images)."""
    output = x if hasattr(x, "get_partial_shape") else x.output(0)  # an output, or its node
    return [size.get_length() for size in list(output.get_partial_shape())[1:]]


def count_values(x: Any) -> int:
    """Number of values of a node's result per image."""
    return int(np.prod(sizes(x)))


def is_of_one_image(x: Any) -> bool:
    """Whether the graph is for a single image, which makes it faster."""
    return bool(x.get_output_partial_shape(0)[0].is_static)


def columns(ops: Any, x: Any, first: int, last: int) -> Any:
    """Columns `first` to `last` (exclusive) of x (B, N)."""
    return part_of(ops, x, 1, first, last)


def part_of(ops: Any, x: Any, axis: int, first: int, last: int) -> Any:
    """The part of x from `first` to `last` (exclusive) along an axis."""
    return ops.slice(x, np.array([first]), np.array([last]), np.array([1]), np.array([axis]))


def linear_float32(ops: Any, x: Any, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Any:
    """Linear layer with weight (N, F) and bias (N,) on x (B, F): (B, N)."""
    return ops.add(product_float32(ops, x, weight), bias[None])


def product_float32(ops: Any, x: Any, weight: NDArray[np.float32]) -> Any:
    """Product (B, N) of x (B, F) and the transpose of weight (N, F)."""
    if not is_of_one_image(x):
        each = ops.multiply(ops.unsqueeze(x, np.array([1])), ops.constant(weight[None]))
        return without_last_axis(ops, ops.reduce_sum(each, np.array([2]), keep_dims=True))
    # In two dimensions: OpenVINO would reorder three dimensions as the channels of an image.
    sums = ops.reduce_sum(ops.multiply(x, ops.constant(weight)), np.array([1]))
    return ops.unsqueeze(sums, np.array([0]))


def without_last_axis(ops: Any, x: Any) -> Any:
    """Drop the last axis of a sum or mean of several images: (B, N, 1) -> (B, N).

    The sum itself must keep the axis: OpenVINO 2026.4 otherwise adds a following bias (1, N) to the
    wrong values.
    """
    return ops.squeeze(x, np.array([2]))

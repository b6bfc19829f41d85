"""Operations that the parts of a network's OpenVINO graph share; B is the number of images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def sizes(x: Any) -> list[int]:
    """The sizes of a node's result but for the first, the number of images."""
    output = x if hasattr(x, "get_partial_shape") else x.output(0)  # an output, or its node
    return [size.get_length() for size in list(output.get_partial_shape())[1:]]


def count_values(x: Any) -> int:
    """How many numbers a node's result has for each image."""
    return int(np.prod(sizes(x)))


def is_of_one_image(x: Any) -> bool:
    """Whether the number of images is fixed: a graph for that one is quicker."""
    return bool(x.get_output_partial_shape(0)[0].is_static)


def columns(ops: Any, x: Any, first: int, last: int) -> Any:
    """Columns `first` to before `last` of x (B, N)."""
    return part_of(ops, x, 1, first, last)


def part_of(ops: Any, x: Any, axis: int, first: int, last: int) -> Any:
    """What x holds from `first` to before `last` along an axis."""
    return ops.slice(x, np.array([first]), np.array([last]), np.array([1]), np.array([axis]))


def linear_float32(ops: Any, x: Any, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Any:
    """Linear layer with weight (N, F) and bias (N,) on x (B, F): (B, N)."""
    return ops.add(product_float32(ops, x, weight), bias[None])


def product_float32(ops: Any, x: Any, weight: NDArray[np.float32]) -> Any:
    """x (B, F) times weight (N, F) transposed: (B, N)."""
    if not is_of_one_image(x):
        each = ops.multiply(ops.unsqueeze(x, np.array([1])), ops.constant(weight[None]))
        return without_last_axis(ops, ops.reduce_sum(each, np.array([2]), keep_dims=True))
    # In two dimensions: OpenVINO would lay out three as the channels of an image, and back.
    sums = ops.reduce_sum(ops.multiply(x, ops.constant(weight)), np.array([1]))
    return ops.unsqueeze(sums, np.array([0]))


def without_last_axis(ops: Any, x: Any) -> Any:
    """(B, N, 1) -> (B, N), of a sum or mean of several images.

    Not by the sum itself: OpenVINO 2026.4 adds a bias (1, N) after it to the wrong numbers then.
    """
    return ops.squeeze(x, np.array([2]))

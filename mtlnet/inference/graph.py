"""A network as an OpenVINO graph, built operation by operation from architecture and weights.

Free of torch, and nothing is traced or converted: it is an implementation independent of torch's,
with OpenVINO's own SAME padding. An engine therefore needs only a folder with weights.

The heads and the uncertainty head are computed in float32 even where the rest is in bf16. OpenVINO
rounds the results of a MatMul to bf16, in steps of 0.004 near 1, which is 0.025 m or 0.005 rad;
element-wise operations at the end of a graph stay in float32. The directions of the texture remain
a MatMul: their result, a sum of squares, is then wrong by 0.1 %, at most 0.5 %.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.architecture import (
    ABSENT_ABOVE,
    ANGLE_BINS,
    BIN_VARIANCE,
    DISTANCE_BINS,
    HEIGHT,
    NEAR,
    PAIR,
    WIDTH,
    Architecture,
    Conv,
    LocalNorm,
    Pool,
    find_architecture,
)
from mtlnet.inference.graph_operations import (
    columns,
    count_values,
    linear_float32,
    part_of,
)
from mtlnet.inference.uncertainty import UncertaintyHead
from mtlnet.inference.uncertainty_graph import uncertainty_outputs
from trackfeatures.coding import OFFSET, SPAN

MARKINGS = len(tf.MARKINGS)
Weights = Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Nodes:
    """Nodes of a network on which other parts of a graph build."""

    images: Any  # uint8 (B, H, W, 3)
    uncertainty_inputs: Any  # (B, F): last shared features; for bins, log spreads too
    outputs: Any  # (B, 9): see `mtlnet.inference.prediction`
    absent: Any = None  # (B, 5), for bins: probabilities that each marking is absent


def network_nodes(
    ops: Any,
    architecture: Architecture,
    weights: Weights,
    features: Callable[[Any], Any] | None = None,
    batch: int = 1,
) -> Nodes:
    """Nodes of a folded network with these `weights`, named as in torch.

    `features`: computes the features from the pixels; None: the architecture's own layers. `batch`:
    number of images; -1: any number, which is slower for a single image.
    """
    images = ops.parameter([batch, HEIGHT, WIDTH, 3], np.uint8, name="images")
    first_row = architecture.first_row
    # Before the transpose, which OpenVINO then leaves to the first convolution.
    x = part_of(ops, images, 1, first_row, HEIGHT) if first_row else images
    x = ops.convert(x, np.float32)
    x = ops.subtract(ops.multiply(x, np.float32(1 / 127.5)), np.float32(1))
    pixels = ops.transpose(x, np.array([0, 3, 1, 2]))
    x = (
        features(pixels)
        if features is not None
        else convolutions(ops, pixels, architecture, weights)
    )
    x = ops.reshape(x, np.array([-1, count_values(x)]), special_zero=False)
    for number in range(len(architecture.shared)):
        x = ops.relu(_linear(ops, x, weights, f"shared.fc{number}.layer"))
    distance, angle, kind = (
        linear_float32(ops, x, weights[f"heads.{name}.weight"], weights[f"heads.{name}.bias"])
        for name, _ in architecture.heads
    )
    coded, inputs, absent = [distance, angle], x, None
    if architecture.bins:
        scores = ops.reshape(distance, np.array([-1, DISTANCE_BINS + 1]), special_zero=False)
        absent = absent_probabilities(ops, scores)
        coded = [read_bins(ops, scores, angle, absent)]
        inputs = ops.concat([x, *_log_spreads(ops, scores, angle)], 1)
    outputs = ops.concat([*coded, ops.softmax(kind, 1)], 1)
    return Nodes(images, inputs, outputs, absent)


def model_of(nodes: Nodes, head: UncertaintyHead | None = None) -> Any:
    """OpenVINO model uint8 (B, 210, 280, 3) -> float32 (B, 9).

    `head` adds 8 columns; then heads over bins add 5.
    """
    import openvino
    from openvino import opset13 as ops

    second = (
        []
        if head is None
        else uncertainty_outputs(ops, nodes.uncertainty_inputs, nodes.images, head)
    )
    third = [] if nodes.absent is None else [nodes.absent]
    outputs = ops.concat([nodes.outputs, *second, *third], 1)
    return openvino.Model([ops.result(outputs)], [nodes.images], "mtlnet")


def model_from_weights(network: str, weights: Weights, head: UncertaintyHead | None = None) -> Any:
    """OpenVINO model of the network with this name and these weights."""
    from openvino import opset13 as ops

    return model_of(network_nodes(ops, find_architecture(network), weights), head)


def convolutions(ops: Any, x: Any, architecture: Architecture, weights: Weights) -> Any:
    """Layers before the shared ones, (B, 3, H - first_row, W) -> (B, C, h, w)."""
    for number, spec in enumerate(architecture.features):
        if isinstance(spec, LocalNorm):
            x = ops.lrn(x, np.array([1]), spec.alpha, spec.beta, 1.0, spec.size)
        elif isinstance(spec, Pool):
            x = _pool(ops, x, spec)
        else:
            name = f"features.conv{number}.layer"
            y = _convolution(ops, x, spec, weights[f"{name}.weight"])
            y = ops.relu(ops.add(y, weights[f"{name}.bias"].reshape(1, -1, 1, 1)))
            x = ops.add(x, y) if spec.skip else y
    return x


def _convolution(ops: Any, x: Any, spec: Conv, weight: NDArray[np.float32]) -> Any:
    how = {"auto_pad": "same_upper"} if spec.pad is None else {}
    pads = [spec.pad or 0] * 2
    return convolution(ops, x, weight, [spec.stride] * 2, pads, spec.groups, **how)


def convolution(
    ops: Any,
    x: Any,
    weight: NDArray[np.float32],
    stride: list[int],
    pads: list[int],
    groups: int = 1,
    **how: str,
) -> Any:
    """Convolution with a kernel (F, C, k, k), without bias."""
    convolve = ops.convolution
    if groups > 1:
        outputs, inputs, *kernel = weight.shape
        weight = weight.reshape(groups, outputs // groups, inputs, *kernel)
        convolve = ops.group_convolution
    return convolve(x, ops.constant(weight), stride, pads, pads, [1, 1], **how)


def _pool(ops: Any, x: Any, spec: Pool) -> Any:
    sizes = ([spec.stride] * 2, [1, 1], [0, 0], [0, 0], [spec.kernel] * 2)
    how = {"auto_pad": "same_upper"} if spec.same else {"rounding_type": "ceil"}
    return ops.max_pool(x, *sizes, **how).output(0)


def _linear(ops: Any, x: Any, weights: Weights, name: str) -> Any:
    # A plain array would first be converted to a list of numbers, which takes longer than the rest.
    product = ops.matmul(x, ops.constant(weights[f"{name}.weight"]), False, True)
    return ops.add(product, weights[f"{name}.bias"][None])


def absent_probabilities(ops: Any, scores: Any) -> Any:
    """Probabilities (B, 5) that each marking is absent, from scores (5 B, DISTANCE_BINS + 1)."""
    absent = _rows(ops, columns(ops, ops.softmax(scores, 1), DISTANCE_BINS, DISTANCE_BINS + 1))
    # `ml` and `mr` are absent together.
    pair = ops.reduce_mean(columns(ops, absent, 0, PAIR.stop), np.array([1]), keep_dims=True)
    return ops.concat([pair] * PAIR.stop + [columns(ops, absent, PAIR.stop, MARKINGS)], 1)


def read_bins(ops: Any, scores: Any, angle: Any, absent: Any) -> Any:
    """Coded answers (B, 6) from the scores of the distances and of the angle.

    `scores` (5 B, DISTANCE_BINS + 1), `angle` (B, ANGLE_BINS); `absent` (B, 5): probabilities that
    each marking is absent.
    """
    found = _rows(ops, _expectation(ops, columns(ops, scores, 0, DISTANCE_BINS), DISTANCE_BINS))
    spans = [tf.RANGES[name] for name in tf.MARKINGS]
    ends = np.array([[float(span.inactive != span.lo) for span in spans]], np.float32)
    limits = np.array(ABSENT_ABOVE, np.float32)[None]
    shares = ops.select(ops.greater(absent, limits), ends, found)
    row = ops.concat([shares, _expectation(ops, angle, ANGLE_BINS)], 1)
    return ops.add(ops.multiply(row, np.float32(SPAN)), np.float32(OFFSET))


def _rows(ops: Any, column: Any) -> Any:
    """Values (B, 5) from a column (5 B, 1)."""
    return ops.reshape(column, np.array([-1, MARKINGS]), special_zero=False)


def _expectation(ops: Any, scores: Any, count: int) -> Any:
    """Expectation (N, 1) in [0, 1] of scores (N, count), over the bins within NEAR of the
    likeliest."""
    axis = np.array([1])
    number = np.arange(count, dtype=np.float32)[None]
    highest = ops.reduce_max(scores, axis, keep_dims=True)
    # The first bin with the highest score, as torch's argmax; the other bins get `count`.
    places = ops.select(ops.equal(scores, highest), number, np.float32(count))
    best = ops.reduce_min(places, axis, keep_dims=True)
    near = ops.less_equal(ops.abs(ops.subtract(number, best)), np.float32(NEAR))
    weight = ops.exp(ops.subtract(scores, highest))
    weight = ops.select(near, weight, np.float32(0))
    middle = (number + 0.5) / np.float32(count)
    total = ops.reduce_sum(weight, axis, keep_dims=True)
    return ops.divide(ops.reduce_sum(ops.multiply(weight, middle), axis, keep_dims=True), total)


def _log_spreads(ops: Any, scores: Any, angle: Any) -> list[Any]:
    """`mtlnet.model.bins.log_spreads`: (B, 5) of the distances and (B, 1) of the angle."""
    distances = _log_spread(ops, columns(ops, scores, 0, DISTANCE_BINS), DISTANCE_BINS)
    return [_rows(ops, distances), _log_spread(ops, angle, ANGLE_BINS)]


def _log_spread(ops: Any, scores: Any, count: int) -> Any:
    """Logarithm (N, 1) of the standard deviation, in bins, of scores (N, count)."""
    axis = np.array([1])
    number = np.arange(count, dtype=np.float32)[None]
    share = ops.softmax(scores, 1)
    mean = ops.reduce_sum(ops.multiply(share, number), axis, keep_dims=True)
    away = ops.subtract(number, mean)
    squares = ops.multiply(share, ops.multiply(away, away))
    variance = ops.reduce_sum(squares, axis, keep_dims=True)
    half = np.float32(0.5)
    return ops.multiply(ops.log(ops.add(variance, np.float32(BIN_VARIANCE))), half)

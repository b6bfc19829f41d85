"""Distributions over bins for distances and angle: the targets, and the answer from the scores.

A distance is a softmax over 70 bins (`DISTANCE_BINS`) of its range (`trackfeatures.RANGES`) and a
class "absent"; the angle is a softmax over 100 bins (`ANGLE_BINS`). The target of a value is a
normal distribution around it, integrated over each bin (HL-Gauss; Imani and White 2018, Farebrother
et al. 2024). The answer is the expectation over the likeliest bin and the 4 bins on each side of
it. Where a distance jumps from one marking to the next, a regression would answer with a value in
between; a distribution has two peaks, and the answer is at the higher one.

The functions are torch operations without branches, so that they can be part of an exported
network.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import log_softmax

import trackfeatures as tf
from mtlnet.architecture import ABSENT_ABOVE, ANGLE_BINS, BIN_VARIANCE, DISTANCE_BINS, NEAR, PAIR
from trackfeatures.coding import OFFSET, SPAN

SPREAD = 1.0
"""Standard deviation of a target distribution, in bins."""

_SPANS = [tf.RANGES[name] for name in tf.TARGETS]


@dataclass(frozen=True)
class Scores:
    """The outputs of the heads for B images, before the softmax: `distance` (B, 5, 71), whose last
    column is "absent"; `angle` (B, 100); `heading` (B, 3)."""

    distance: Tensor  # (B, 5, DISTANCE_BINS + 1), the last "absent"
    angle: Tensor  # (B, ANGLE_BINS)
    heading: Tensor  # (B, 3)


def split_scores(distance: Tensor, angle: Tensor, heading: Tensor) -> Scores:
    """Make Scores from the outputs of the heads: `distance` (B, 5 * 71), `angle` (B, 100) and
    `heading` (B, 3)."""
    return Scores(distance.reshape(-1, len(tf.MARKINGS), DISTANCE_BINS + 1), angle, heading)


def normal_targets(values: Tensor, low: float, high: float, count: int) -> Tensor:
    """Compute the target probabilities (..., `count`) of `count` equal bins between `low` and
    `high` for values (...): a normal distribution around each value, with a standard deviation of
    one bin.

    Values are clipped to the range, and the distribution is truncated to it.
    """
    width = (high - low) / count
    edges = torch.linspace(low, high, count + 1, dtype=values.dtype, device=values.device)
    away = (edges - values.clamp(low, high)[..., None]) / (SPREAD * width)
    below = torch.special.ndtr(away)
    mass: Tensor = (below[..., 1:] - below[..., :-1]) / (below[..., -1:] - below[..., :1])
    return mass


def bin_targets(coded: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the target distributions of the distances (B, 5, 71) and of the angle (B, 100) for
    coded targets (B, 6)."""
    values = _decoded(coded)
    absent = absent_in(coded)
    each = []
    for column in range(len(tf.MARKINGS)):
        span = _SPANS[column]
        places = normal_targets(values[:, column], span.lo, span.hi, DISTANCE_BINS)
        here = ~absent[:, column : column + 1]
        each.append(torch.cat([places * here, (~here).to(places)], 1))
    angle = normal_targets(values[:, -1], _SPANS[-1].lo, _SPANS[-1].hi, ANGLE_BINS)
    return torch.stack(each, 1), angle


def absent_in(coded: Tensor) -> Tensor:
    """Return whether each distance of coded targets (B, 6) is absent, bool (B, 5).

    A label codes an absent marking as one end of its range (`inactive` in `trackfeatures.RANGES`);
    a marking that is present never reaches that end.
    """
    ends = [span.inactive for span in _SPANS[:-1]]
    there = _numbers(ends, coded)
    low, width = _ranges(coded)
    return (coded[:, :-1] - _code(there, low[:-1], width[:-1])).abs() < _SAME


_SAME = 1e-4
"""Coded values that differ by less than this count as equal. The rounding error of float32 is a
thousandth of it; the code of a present marking differs from the code of absence by 0.02 or more."""


def read_scores(distance: Tensor, angle: Tensor) -> Tensor:
    """Compute the coded answers (B, 6), five distances and the angle, from the scores of the
    distances (B, 5, 71) and of the angle (B, 100).

    A distance whose probability of absence exceeds its limit (`ABSENT_ABOVE`, 0.54 or 0.75) gets
    the code of an absent marking, as in a label.
    """
    absent = absent_probabilities(distance)
    found = expectation(distance[:, :, :-1])  # in [0, 1] of the range
    ends = _numbers([0.0 if span.inactive == span.lo else 1.0 for span in _SPANS[:-1]], found)
    limits = _numbers(ABSENT_ABOVE, absent)
    shares = torch.where(absent > limits, ends.expand_as(found), found)
    shares = torch.cat([shares, expectation(angle)[:, None]], 1)
    return OFFSET + SPAN * shares


def absent_probabilities(distance: Tensor) -> Tensor:
    """Compute the probability that each marking is absent (B, 5) from the scores `distance`
    (B, 5, 71), whose last column is "absent".

    `ml` and `mr` are always absent together, so both get the mean of their two probabilities.
    """
    absent = torch.softmax(distance, 2)[:, :, -1]
    pair = absent[:, PAIR].mean(1, keepdim=True).expand(-1, 2)
    return torch.cat([pair, absent[:, PAIR.stop :]], 1)


def expectation(scores: Tensor) -> Tensor:
    """Compute expected values (...) from the scores (..., count) of `count` bins. A value is a
    share of the bins' range, in [0, 1]. Only the likeliest bin and the 4 bins on each side of it
    are included."""
    count = scores.shape[-1]
    number = torch.arange(count, dtype=torch.float32, device=scores.device)
    best = scores.argmax(-1, keepdim=True).to(torch.float32)
    near = (number - best).abs() <= NEAR
    weight = torch.exp(scores.float() - scores.float().amax(-1, keepdim=True)) * near
    return (weight * ((number + 0.5) / count)).sum(-1) / weight.sum(-1)


def log_spreads(distance: Tensor, angle: Tensor) -> Tensor:
    """Compute the logarithms (B, 6) of the standard deviations, in bins, of the distributions that
    the scores of the distances (B, 5, 71) and of the angle (B, 100) define.

    All bins except "absent" are included, so that two separate peaks give a large value.
    """
    spreads = [_log_spread(distance[:, :, :-1]), _log_spread(angle)[:, None]]
    return torch.cat(spreads, 1)


def _log_spread(scores: Tensor) -> Tensor:
    """Logarithms (...) of the standard deviations, in bins, for scores (..., count)."""
    number = torch.arange(scores.shape[-1], dtype=torch.float32, device=scores.device)
    share = torch.softmax(scores.float(), -1)
    mean = (share * number).sum(-1, keepdim=True)
    return 0.5 * torch.log((share * (number - mean) ** 2).sum(-1) + BIN_VARIANCE)


def soft_cross_entropy(scores: Tensor, targets: Tensor) -> Tensor:
    """Compute the cross-entropy (...) of scores (..., count) for target distributions
    (..., count)."""
    return -(targets * log_softmax(scores, -1)).sum(-1)


def _ranges(like: Tensor) -> tuple[Tensor, Tensor]:
    """Lower ends (6,) and widths (6,) of the ranges, in m and rad, like the tensor `like`."""
    low = _numbers([span.lo for span in _SPANS], like)
    return low, _numbers([span.hi for span in _SPANS], like) - low


def _numbers(values: Sequence[float | None], like: Tensor) -> Tensor:
    """Constants as a tensor of the type and on the device of `like`.

    On a GPU the tensor is cached, because nothing may be copied from the host's memory while a CUDA
    graph is recorded. On a CPU it is created anew, because an export traces this code with tensors
    that hold no values.
    """
    if like.is_cuda:
        return _kept_numbers(tuple(values), like.dtype, like.device)
    return torch.tensor(values, dtype=like.dtype, device=like.device)


@lru_cache
def _kept_numbers(
    values: tuple[float | None, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)


def _code(values: Tensor, low: Tensor, width: Tensor) -> Tensor:
    return OFFSET + SPAN * (values - low) / width


def _decoded(coded: Tensor) -> Tensor:
    low, width = _ranges(coded)
    return low + (coded - OFFSET) / SPAN * width

"""The losses, against values worked out by hand; parsing of --alpha."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from mtlnet.architecture import ANGLE_BINS, DISTANCE_BINS
from mtlnet.model.bins import bin_targets, soft_cross_entropy, split_scores
from mtlnet.training.losses.bins import bins_loss
from mtlnet.training.losses.multi_task import Terms, multi_task_loss
from mtlnet.training.losses.task_weighting import TaskWeighting
from mtlnet.training.losses.task_weights import AlphaError, parse_alpha
from mtlnet.training.recipes import RECIPES, HuberLoss

OUTPUTS = torch.tensor(
    [
        [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0],
        [0.1, 0.9, 0.1, 0.9, 0.9, 0.4, 0.0, math.log(2.0), 0.0],
    ]
)
TARGETS = torch.tensor([[0.4, 0.5, 0.5, 0.7, 0.5, 0.5], [0.1, 0.9, 0.1, 0.9, 0.9, 0.7]])
HEADING = torch.tensor([0, 1])
DISTANCE = (0.1**2 + 0.2**2) / 2
ANGLE = 0.3**2 / 2
CROSS_ENTROPY = (math.log(3) + math.log(2)) / 2  # probabilities 1/3 and 2/4


def by_alpha(*alpha: float) -> Callable[[Terms], torch.Tensor]:
    distance, angle, heading = alpha
    return TaskWeighting("fixed", (distance, angle, heading), torch.device("cpu")).total


def test_losses_equal_those_by_hand() -> None:
    losses = multi_task_loss(OUTPUTS, TARGETS, HEADING, by_alpha(0.3, 0.2, 0.5))
    assert float(losses.distance) == pytest.approx(DISTANCE)
    assert float(losses.angle) == pytest.approx(ANGLE)
    assert float(losses.heading) == pytest.approx(CROSS_ENTROPY)
    assert float(losses.total) == pytest.approx(0.3 * DISTANCE + 0.2 * ANGLE + 0.5 * CROSS_ENTROPY)


def test_scaled_losses_are_in_units_of_the_target_variance() -> None:
    scale = torch.tensor([0.01, 0.01, 0.01, 0.04, 0.01, 0.09])
    losses = multi_task_loss(OUTPUTS, TARGETS, HEADING, by_alpha(1.0, 2.0, 0.0), scale)
    # Distances: mean over two images and five targets of 1 and 1; angle: one of two is 1.
    assert float(losses.total) == pytest.approx(2 / 10 + 2 * 1 / 2)
    assert float(losses.distance) == pytest.approx(DISTANCE)


def test_huber_losses_equal_those_by_hand() -> None:
    scale = torch.tensor([0.01, 0.01, 0.01, 0.04, 0.01, 0.09])
    # In standard deviations two distances err by 1 and the angle of one image of two by 1.
    huber = HuberLoss(distance_beta=0.5, angle_beta=0.8, distance_gain=2.5, angle_gain=5.0)
    linear = multi_task_loss(OUTPUTS, TARGETS, HEADING, by_alpha(1.0, 2.0, 0.0), scale, huber)
    angle = 5.0 * (1 - 0.8 / 2) / 2
    assert float(linear.total) == pytest.approx(2.5 * 2 / 10 * (1 - 0.25) + 2 * angle)
    # Below beta: the square over twice beta.
    huber = replace(huber, distance_beta=2.0)
    squared = multi_task_loss(OUTPUTS, TARGETS, HEADING, by_alpha(1.0, 2.0, 0.0), scale, huber)
    assert float(squared.total) == pytest.approx(2.5 * 2 / 10 / 4 + 2 * angle)
    assert float(linear.distance) == pytest.approx(DISTANCE)


def test_the_recipe_holds_the_gains_of_the_loss() -> None:
    assert RECIPES["fast"].huber == HuberLoss(0.05, 1.0, 2.5, 5.0)
    assert RECIPES["tune"].huber == RECIPES["fast"].huber
    assert RECIPES["paper"].huber is None


def test_between_two_values_the_huber_loss_is_least_at_the_likelier() -> None:
    # 60 images in 100 have 0.2 as their first distance, the others 0.8.
    targets = torch.full((100, 6), 0.5)
    targets[:, 0] = torch.where(torch.arange(100) < 60, 0.2, 0.8)
    outputs = [
        torch.full((100, 9), 0.5).index_fill(1, torch.tensor([0]), value / 100)
        for value in range(101)
    ]
    for huber, best in ((None, 0.6 * 0.2 + 0.4 * 0.8), (HuberLoss(0.05), 0.2)):
        costs = [
            float(
                multi_task_loss(
                    a,
                    targets,
                    HEADING[:1].expand(100),
                    by_alpha(1.0, 0.0, 0.0),
                    torch.full((6,), 0.09),
                    huber,
                ).total
            )
            for a in outputs
        ]
        assert costs.index(min(costs)) / 100 == pytest.approx(best, abs=0.011)


def test_a_task_of_weight_zero_has_no_gradient() -> None:
    outputs = OUTPUTS.clone().requires_grad_()
    torch.autograd.backward(
        multi_task_loss(outputs, TARGETS, HEADING, by_alpha(0.0, 1.0, 0.0)).total
    )
    assert outputs.grad is not None
    assert outputs.grad[:, [0, 1, 2, 3, 4, 6, 7, 8]].abs().sum() == 0
    assert outputs.grad[1, 5] == pytest.approx(2 * -0.3 / 2)


def test_alpha_may_have_any_sum() -> None:
    assert parse_alpha("0.3,0.2,0.5") == (0.3, 0.2, 0.5)
    assert parse_alpha(" 0, 7 ,0") == (0.0, 7.0, 0.0)


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("0.3,0.2", r"2 weight\(s\)"),
        ("0.3,0.2,0.5,1", r"4 weight\(s\)"),
        ("0.3,,0.5", "missing or not a number"),
        ("0.3,x,0.5", "missing or not a number"),
        ("0.3,-0.2,0.5", "weight for angle is -0.2"),
        ("nan,0.2,0.5", "weight for distance is nan"),
        ("0.3,0.2,inf", "weight for heading is inf"),
        ("0,0,0", "nothing to learn"),
        ("", r"1 weight\(s\)"),
    ],
)
def test_wrong_alpha_is_refused(text: str, seen: str) -> None:
    with pytest.raises(AlphaError, match=seen):
        parse_alpha(text)


def test_unknown_labels_have_no_loss_and_are_not_counted() -> None:
    nan = math.nan
    targets = torch.tensor([[0.4, 0.5, nan, nan, nan, 0.5], [nan, nan, 0.1, 0.9, 0.7, 0.7]])
    outputs = OUTPUTS.clone().requires_grad_()
    losses = multi_task_loss(outputs, targets, torch.tensor([-1, 1]), by_alpha(1.0, 1.0, 1.0))
    # Five of ten distances are known; two of them err, by 0.1 and 0.2. One class is known.
    distance = (0.1**2 + 0.2**2) * 10 / 5 / 2
    assert float(losses.distance.detach()) == pytest.approx(distance)
    assert float(losses.heading.detach()) == pytest.approx(math.log(2))
    assert float(losses.total.detach()) == pytest.approx(distance + ANGLE + math.log(2))
    losses.total.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    gradient = outputs.grad
    assert gradient is not None
    assert gradient[0, 2:5].tolist() == [*gradient[1, :2].tolist(), 0.0] == [0.0] * 3
    assert gradient[0, 6:].tolist() == [0.0] * 3
    assert float(gradient[0, 0]) == pytest.approx(2 * 0.1 * 10 / 5 / 2)
    # No known label: the loss is 0, not NaN.
    none = torch.full((2, 6), nan)
    none[:, 5] = 0.5
    nothing = multi_task_loss(OUTPUTS, none, torch.tensor([-1, -1]), by_alpha(1.0, 0.0, 1.0))
    assert float(nothing.total) == 0.0


def test_unknown_labels_have_no_loss_in_bins() -> None:
    generator = torch.Generator().manual_seed(0)
    scores = split_scores(
        torch.randn(2, 5 * (DISTANCE_BINS + 1), generator=generator),
        torch.randn(2, ANGLE_BINS, generator=generator),
        torch.randn(2, 3, generator=generator),
    )
    combine = by_alpha(1.0, 1.0, 1.0)
    # Of two images that differ in what is known, the loss is that of the known columns.
    coded = torch.tensor([[0.3, 0.6, 0.1, 0.9, 0.9, 0.5]] * 2)
    full = bins_loss(scores, coded, torch.tensor([0, 1]), combine)
    hidden = coded.clone()
    hidden[0, 2:5] = math.nan
    part = bins_loss(scores, hidden, torch.tensor([-1, 1]), combine)
    targets, _ = bin_targets(coded)
    each = soft_cross_entropy(scores.distance, targets)
    known = torch.cat([each[0, :2], each[1]])
    assert float(part.terms[0]) == pytest.approx(float(known.mean()))
    assert float(full.terms[0]) == pytest.approx(float(each.mean()))
    assert float(part.terms[1]) == float(full.terms[1])
    likely = torch.log_softmax(scores.heading, 1)
    assert float(part.terms[2]) == pytest.approx(-float(likely[1, 1]))
    assert math.isfinite(float(part.distance))

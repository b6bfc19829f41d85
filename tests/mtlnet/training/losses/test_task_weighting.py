"""Task weighting by uncertainty and by dwa, against values worked out by hand."""

import math
from pathlib import Path

import pytest
import torch

from mtlnet.training.config import TrainConfig
from mtlnet.training.losses.task_weighting import TaskWeighting
from trackfeatures.errors import UserError

CPU = torch.device("cpu")
TERMS = torch.tensor([0.8, 0.2, 1.1])


def weighting(
    method: str, alpha: tuple[float, float, float] = (0.3, 0.2, 0.5), steps_per_epoch: int = 1
) -> TaskWeighting:
    return TaskWeighting(method, alpha, CPU, steps_per_epoch)


def test_uncertainty_weighting_equals_equation_7_of_kendall() -> None:
    tasks = weighting("uncertainty")
    with torch.no_grad():
        tasks.log_variance.copy_(torch.tensor([math.log(2.0), 0.0, math.log(0.5)]))
    total = tasks.total(TERMS.unbind())
    # exp(-s) L / 2 + s / 2 for the errors, exp(-s) L + s / 2 for the class; the s add up to 0.
    assert float(total) == pytest.approx(0.8 / 4 + 0.2 / 2 + 2 * 1.1)
    torch.autograd.backward(total)
    assert tasks.log_variance.grad is not None
    expected = [0.5 - 0.8 / 4, 0.5 - 0.2 / 2, 0.5 - 2 * 1.1]
    assert tasks.log_variance.grad.tolist() == pytest.approx(expected)
    assert tasks.current_weights() == pytest.approx([0.25, 0.5, 2.0])


def test_learned_variances_converge_to_the_terms() -> None:
    tasks = weighting("uncertainty")
    optimiser = torch.optim.SGD(tasks.parameters, 0.2)
    for _ in range(400):
        optimiser.zero_grad()
        torch.autograd.backward(tasks.total(TERMS.unbind()))
        optimiser.step()
    # The minimum over s: exp(s) = L for an error, 2 L for a class.
    assert tasks.log_variance.exp().tolist() == pytest.approx([0.8, 0.2, 2.2], rel=1e-3)


def test_a_task_of_weight_zero_is_not_learned() -> None:
    tasks = weighting("uncertainty", (1.0, 0.0, 1.0))
    terms = TERMS.clone().requires_grad_()
    torch.autograd.backward(tasks.total(terms.unbind()))
    assert terms.grad is not None
    assert terms.grad.tolist() == pytest.approx([0.5, 0.0, 1.0])
    assert tasks.log_variance.grad is not None
    assert float(tasks.log_variance.grad[1]) == 0.0
    assert tasks.current_weights() == pytest.approx([0.5, 0.0, 1.0])


def test_dwa_equals_equation_7_of_liu() -> None:
    tasks = weighting("dwa", steps_per_epoch=2)
    assert tasks.current_weights() == [1.0, 1.0, 1.0]
    windows = [(1.0, 1.0, 1.0), (0.5, 0.8, 1.0)]
    for window in windows:
        for offset in (-0.25, 0.25):  # only the mean of a window counts
            assert tasks.current_weights() == [1.0, 1.0, 1.0]
            tasks.update(torch.tensor(window) + offset)
    shares = [math.exp(pace / 2) for pace in (0.5, 0.8, 1.0)]
    expected = [3 * share / sum(shares) for share in shares]
    assert tasks.current_weights() == pytest.approx(expected)
    assert float(tasks.total(TERMS.unbind())) == pytest.approx(
        sum(w * t for w, t in zip(expected, TERMS.tolist(), strict=True))
    )


def test_dwa_weights_of_two_tasks_sum_to_two() -> None:
    tasks = weighting("dwa", (1.0, 0.0, 3.0))
    tasks.update(torch.tensor([1.0, 9.0, 1.0]))
    tasks.update(torch.tensor([0.9, 9.0, 0.3]))
    shares = [math.exp(0.45), math.exp(0.15)]
    expected = [2 * shares[0] / sum(shares), 0.0, 2 * shares[1] / sum(shares)]
    assert tasks.current_weights() == pytest.approx(expected)


def test_restored_weighting_continues_alike() -> None:
    first, second = weighting("dwa", steps_per_epoch=2), weighting("dwa", steps_per_epoch=2)
    for number in range(5):
        first.update(TERMS * (1 + number))
    second.restore(first.state())
    for one in (first, second):
        one.update(TERMS.square())
    assert first.current_weights() == second.current_weights()
    assert len(set(first.current_weights())) == 3


def test_dwa_continues_with_a_shorter_window() -> None:
    """Fewer frames have a shorter epoch. Constant losses have equal weights."""
    first, second = weighting("dwa", steps_per_epoch=8), weighting("dwa", steps_per_epoch=2)
    for _ in range(8 + 6):  # a whole window, and a part longer than the next window
        first.update(TERMS)
    second.restore(first.state())
    for _ in range(5):
        second.update(TERMS)
        assert second.previous_means.tolist() == pytest.approx(TERMS.tolist())
        assert second.current_weights() == pytest.approx([1.0, 1.0, 1.0])


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(UserError, match="no balance 'best'; choose one of fixed, uncertainty, dwa"):
        TrainConfig(Path("data"), Path("out"), balance="best")

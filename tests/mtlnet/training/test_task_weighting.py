"""Weights that the tasks find themselves, with numbers worked out by hand."""

import math
from pathlib import Path

import pytest
import torch

from mtlnet.training.config import TrainConfig
from mtlnet.training.task_weighting import Balance
from trackfeatures.errors import UserError

CPU = torch.device("cpu")
TERMS = torch.tensor([0.8, 0.2, 1.1])


def balance(
    kind: str, alpha: tuple[float, float, float] = (0.3, 0.2, 0.5), epoch: int = 1
) -> Balance:
    return Balance(kind, alpha, CPU, epoch)


def test_uncertainty_is_kendalls() -> None:
    weighed = balance("uncertainty")
    with torch.no_grad():
        weighed.log_variance.copy_(torch.tensor([math.log(2.0), 0.0, math.log(0.5)]))
    total = weighed.total(TERMS)
    # exp(-s) L / 2 + s / 2 for the errors, exp(-s) L + s / 2 for the class; the s add up to 0.
    assert float(total) == pytest.approx(0.8 / 4 + 0.2 / 2 + 2 * 1.1)
    torch.autograd.backward(total)
    assert weighed.log_variance.grad is not None
    expected = [0.5 - 0.8 / 4, 0.5 - 0.2 / 2, 0.5 - 2 * 1.1]
    assert weighed.log_variance.grad.tolist() == pytest.approx(expected)
    assert weighed.weights() == pytest.approx([0.25, 0.5, 2.0])


def test_learned_variances_settle_at_the_terms() -> None:
    weighed = balance("uncertainty")
    optimiser = torch.optim.SGD(weighed.parameters, 0.2)
    for _ in range(400):
        optimiser.zero_grad()
        torch.autograd.backward(weighed.total(TERMS))
        optimiser.step()
    # The minimum over s: exp(s) = L for an error, 2 L for a class.
    assert weighed.log_variance.exp().tolist() == pytest.approx([0.8, 0.2, 2.2], rel=1e-3)


def test_a_task_left_out_stays_out() -> None:
    weighed = balance("uncertainty", (1.0, 0.0, 1.0))
    terms = TERMS.clone().requires_grad_()
    torch.autograd.backward(weighed.total(terms))
    assert terms.grad is not None
    assert terms.grad.tolist() == pytest.approx([0.5, 0.0, 1.0])
    assert weighed.log_variance.grad is not None
    assert float(weighed.log_variance.grad[1]) == 0.0
    assert weighed.weights() == pytest.approx([0.5, 0.0, 1.0])


def test_dynamic_weights_are_lius() -> None:
    weighed = balance("dwa", epoch=2)
    assert weighed.weights() == [1.0, 1.0, 1.0]
    stretches = [(1.0, 1.0, 1.0), (0.5, 0.8, 1.0)]
    for stretch in stretches:
        for offset in (-0.25, 0.25):  # only the mean of a stretch counts
            assert weighed.weights() == [1.0, 1.0, 1.0]
            weighed.note(torch.tensor(stretch) + offset)
    shares = [math.exp(pace / 2) for pace in (0.5, 0.8, 1.0)]
    expected = [3 * share / sum(shares) for share in shares]
    assert weighed.weights() == pytest.approx(expected)
    assert float(weighed.total(TERMS)) == pytest.approx(
        sum(w * t for w, t in zip(expected, TERMS.tolist(), strict=True))
    )


def test_dynamic_weights_of_two_tasks_sum_to_two() -> None:
    weighed = balance("dwa", (1.0, 0.0, 3.0))
    weighed.note(torch.tensor([1.0, 9.0, 1.0]))
    weighed.note(torch.tensor([0.9, 9.0, 0.3]))
    shares = [math.exp(0.45), math.exp(0.15)]
    expected = [2 * shares[0] / sum(shares), 0.0, 2 * shares[1] / sum(shares)]
    assert weighed.weights() == pytest.approx(expected)


def test_a_restored_balance_goes_on_as_the_first() -> None:
    first, second = balance("dwa", epoch=2), balance("dwa", epoch=2)
    for number in range(5):
        first.note(TERMS * (1 + number))
    second.restore(first.state())
    for one in (first, second):
        one.note(TERMS.square())
    assert first.weights() == second.weights()
    assert len(set(first.weights())) == 3


def test_a_balance_that_is_none() -> None:
    with pytest.raises(UserError, match="no balance 'best'; choose one of fixed, uncertainty, dwa"):
        TrainConfig(Path("data"), Path("out"), balance="best")

"""A recorded step of every recipe gives the same weights as a step that runs anew each time."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
import torch
from torch import Tensor

import mtlnet.model.bins
import mtlnet.training.trainer
from datagen.recording import Dataset
from mtlnet.architecture import GRID, GRID_RESIDUAL, MTL, Architecture, Conv
from mtlnet.data.gpu_cache import GpuDataset, cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead
from mtlnet.training.cuda_graph import WARM_UP, CudaGraphStep
from mtlnet.training.losses.task_weighting import TaskWeighting
from mtlnet.training.optimizers import OptimizerSet
from mtlnet.training.recipes import RECIPES, learning_rate
from mtlnet.training.trainer import MIN_STEPS_BEFORE_BN_FREEZE, Trainer
from tests.mtlnet.training.tape import Tape, TapeRecorder
from trackfeatures.camera import CameraParameters

CPU = torch.device("cpu")
PROGRESS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.2, 0.61, 0.7, 0.8, 0.85, 0.9, 0.95, 0.97)
"""Progress of the steps; the statistics of batch normalisation are frozen from 0.6 (`fast`) or 0.8
(`continue`) on."""
CASES = [
    ("fast", GRID, "dwa"),
    ("continue", GRID_RESIDUAL, "uncertainty"),
    ("fast", MTL, "fixed"),
]


def thin(plan: Architecture) -> Architecture:
    """The network with few filters and units."""
    few = tuple(replace(s, filters=8) if isinstance(s, Conv) else s for s in plan.features)
    return replace(plan, features=few, shared=(32, 16, 16))


def cached_batches(dataset: Path, device: torch.device, plan: Architecture) -> GpuDataset:
    frames, camera = Dataset.open(dataset).select("train"), CameraParameters()
    ahead = RoadAhead(frames, camera) if plan.bins else None
    loader = Loader(frames, camera, 4, 3, augment=True, ahead=ahead)
    cached = cache_if_it_fits(loader, device, 10**12, plan.first_row)
    assert isinstance(cached, GpuDataset)
    return cached


def build(
    recipe: str, plan: Architecture, balance: str, device: torch.device, *, capturable: bool
) -> Trainer:
    """A trainer whose optimizers are those of a GPU, also on a CPU."""
    alpha = (0.3, 0.2, 0.5)
    weighting = TaskWeighting(balance, alpha, device, steps_per_epoch=2)
    trainer = Trainer(RECIPES[recipe], alpha, 1, device, plan, task_weighting=weighting)
    if capturable:
        extra = trainer.task_weighting.parameters
        trainer.optimizers = OptimizerSet(trainer.network, trainer.recipe, extra, capturable=True)
    trainer.network.target_std.fill_(0.2)
    trainer.step_number = MIN_STEPS_BEFORE_BN_FREEZE
    return trainer


def losses_of(trainer: Trainer, cached: GpuDataset) -> list[float]:
    batches = islice(cached.batches(0), len(PROGRESS))
    return [
        float(trainer.step(batch, progress).total.detach())
        for batch, progress in zip(batches, PROGRESS, strict=True)
    ]


@pytest.fixture
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU the network runs as on a GPU, and constants are kept, as on a GPU."""
    monkeypatch.setattr(mtlnet.training.trainer, "FAST", ())
    kept = mtlnet.model.bins._kept_numbers

    def numbers(values: list[float], like: Tensor) -> Tensor:
        return kept(tuple(values), like.dtype, like.device)

    monkeypatch.setattr(mtlnet.model.bins, "_numbers", numbers)


@pytest.mark.usefixtures("as_on_a_gpu")
@pytest.mark.parametrize(("recipe", "plan", "balance"), CASES)
def test_a_replayed_step_is_the_step(
    dataset: Path, recipe: str, plan: Architecture, balance: str
) -> None:
    """Rates, task weights and batches change with every step; Python runs only in the first."""
    small = thin(plan)
    cached = cached_batches(dataset, CPU, small)
    plain, recorded = (build(recipe, small, balance, CPU, capturable=True) for _ in range(2))
    recorder = TapeRecorder()
    recorded.cuda_graph = CudaGraphStep(recorded.optimize, recorder)
    one, other = losses_of(plain, cached), losses_of(recorded, cached)
    assert one == other
    assert len(set(one)) == len(PROGRESS)
    assert (recorder.recorded, recorder.ran) == (2, 2 * WARM_UP)
    for (name, a), b in zip(
        plain.network.state_dict().items(), recorded.network.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b), name
    weights = plain.task_weighting.current_weights()
    assert recorded.task_weighting.current_weights() == weights


REFUSED: dict[str, Callable[[Tensor], object]] = {
    "item": lambda x: float(x.sum()),
    "branch": lambda x: 1 if x.sum() > 0 else 0,
    "mask": lambda x: x[x > 0],
    "constant": lambda x: x + torch.tensor([1.0, 2.0]),
    "nonzero": lambda x: x.nonzero(),
}


@pytest.mark.parametrize("name", REFUSED)
def test_the_tape_refuses_what_a_cuda_graph_does(name: str) -> None:
    with pytest.raises(AssertionError, match="cannot be part of a CUDA graph"), Tape():
        REFUSED[name](torch.ones(2))


def test_a_number_of_python_is_a_constant_of_the_tape() -> None:
    x, rate, number = torch.ones(2), torch.tensor(2.0), 3.0
    with Tape() as tape:
        x.mul_(rate).add_(number)
    rate.fill_(10.0)
    number = 0.0
    tape.replay()
    assert x.tolist() == [5.0 * 10 + 3] * 2


def test_rates_are_kept_in_one_place_of_memory() -> None:
    trainer = build("fast", thin(GRID), "fixed", CPU, capturable=True)
    groups = [g for part in trainer.optimizers.optimizers for g in part.param_groups]
    places = [group["lr"].data_ptr() for group in groups]
    trainer.optimizers.set_learning_rate(2.0**-12)
    assert [group["lr"].data_ptr() for group in groups] == places
    assert [float(group["lr"]) for group in groups] == [2.0**-9, 2.0**-12, 2.0**-12]
    assert trainer.optimizers.learning_rate == 2.0**-12


@pytest.mark.parametrize("recipe", ["fast", "tune", "paper"])
def test_steps_with_tensors_are_those_with_numbers(recipe: str) -> None:
    """Equal within the precision of float32, in which a tensor holds a rate."""
    ends = []
    for capturable in (False, True):
        trainer = build(recipe, thin(GRID), "fixed", CPU, capturable=capturable)
        generator = torch.Generator().manual_seed(0)
        for step in range(3):
            for parameter in trainer.network.parameters():
                parameter.grad = torch.empty_like(parameter).normal_(generator=generator)
            rate = learning_rate(trainer.recipe, step, 0.1 * step + 0.1)
            trainer.optimizers.set_learning_rate(rate)
            trainer.optimizers.step()
        ends.append(torch.cat([p.detach().flatten() for p in trainer.network.parameters()]))
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize(("recipe", "plan", "balance"), CASES)
def test_a_cuda_graph_replays_every_recipe(
    dataset: Path, recipe: str, plan: Architecture, balance: str
) -> None:
    gpu, small = torch.device("cuda"), thin(plan)
    cached = cached_batches(dataset, gpu, small)
    plain, recorded = (build(recipe, small, balance, gpu, capturable=False) for _ in range(2))
    assert isinstance(recorded.cuda_graph, CudaGraphStep)
    plain.cuda_graph = None
    one, other = losses_of(plain, cached), losses_of(recorded, cached)
    assert recorded.cuda_graph._replay is not None
    assert other == pytest.approx(one, rel=2e-2)
    assert len(set(other)) == len(PROGRESS)

"""A cached dataset gives the loader's batches; a captured training step gives the same weights."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.data.gpu_cache import MEMORY_SHARE, DeviceBatch, GpuDataset, cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.training.cuda_graph import WARM_UP, CudaGraphStep
from mtlnet.training.losses.multi_task import Losses
from mtlnet.training.recipes import RECIPES
from mtlnet.training.trainer import Trainer
from trackfeatures.camera import CameraParameters

CPU = torch.device("cpu")
BATCH = 8
Work = Callable[[], Losses]


def loader(dataset: Path, *, augment: bool = False, part: tuple[int, int] = (0, 1)) -> Loader:
    frames = Dataset.open(dataset).select("train")
    return Loader(frames, CameraParameters(), BATCH, 3, augment=augment, part=part)


@pytest.mark.parametrize("part", [(0, 1), (1, 2)])
def test_cached_batches_are_those_of_the_loader(dataset: Path, part: tuple[int, int]) -> None:
    source = loader(dataset, part=part)
    cached = GpuDataset(source, CPU)
    across_an_epoch = range(5, 16)  # of 9 batches
    for step, batch in zip(across_an_epoch, cached.batches(5), strict=False):
        expected = source.make(step)
        np.testing.assert_array_equal(batch.images.numpy(), expected.images)
        np.testing.assert_array_equal(batch.coded.numpy(), expected.coded)
        np.testing.assert_array_equal(batch.heading.numpy(), expected.heading)


def test_only_data_that_fits_is_cached(dataset: Path) -> None:
    plain, augmented = loader(dataset), loader(dataset, augment=True)
    size = len(plain.frames) * 210 * 280 * 3
    assert isinstance(cache_if_it_fits(plain, CPU, int(size / MEMORY_SHARE) + 1), GpuDataset)
    assert cache_if_it_fits(plain, CPU, int(size / MEMORY_SHARE) - 1) is plain
    assert isinstance(cache_if_it_fits(augmented, CPU, 100 * size), GpuDataset)
    without_sky = cache_if_it_fits(plain, CPU, int(size / MEMORY_SHARE) - 1, first_row=66)
    assert isinstance(without_sky, GpuDataset)
    assert cache_if_it_fits(plain, CPU) is plain  # nothing is cached on a CPU


class FakeRecorder:
    """Replaces a CUDA graph: replaying runs the recorded function again."""

    def __init__(self) -> None:
        self.ran = self.recorded = self.replayed = 0

    def run(self, work: Work) -> Losses:
        self.ran += 1
        return work()

    def record(self, work: Work) -> Work:
        self.recorded += 1

        def again() -> Losses:
            self.replayed += 1
            return work()

        return again


def test_a_captured_step_gets_each_batch_in_the_same_memory() -> None:
    addresses: list[int] = []

    def work(batch: DeviceBatch) -> Losses:
        addresses.append(batch.coded.data_ptr())
        first = batch.coded[0]
        return Losses(first[0], first[1], first[2], first[3], first[:3])

    recorder = FakeRecorder()
    step = CudaGraphStep(work, recorder)
    found = []
    for number in range(12):
        full = torch.full((2, 6), float(number))
        batch = DeviceBatch(torch.zeros(2, 1, 1, 3, dtype=torch.uint8), full, torch.zeros(2).long())
        found.append(step(batch, 1 if number < 6 else 2))
    assert len(set(addresses)) == 1
    assert (recorder.ran, recorder.replayed) == (2 * WARM_UP, 12 - 2 * WARM_UP)
    assert recorder.recorded == 2  # and again once more layers are frozen
    # Losses already returned do not change when the memory is reused.
    replayed = [number for number in range(12) if number % 6 >= WARM_UP]
    assert [float(found[number].total) for number in replayed] == replayed


def steps(trainer: Trainer, cached: GpuDataset, count: int) -> list[float]:
    return [float(trainer.step(batch, 0.1).total) for batch in islice(cached.batches(0), count)]


@pytest.mark.usefixtures("small_network")
def test_captured_training_gives_the_same_weights(dataset: Path) -> None:
    cached = GpuDataset(loader(dataset), CPU)
    recipe = replace(RECIPES["paper"], dropout=0.0, learning_rate=0.02)
    plain, recorded = (Trainer(recipe, (0.3, 0.2, 0.5), 1, CPU) for _ in range(2))
    recorded.cuda_graph = CudaGraphStep(recorded.optimize, FakeRecorder())
    one, other = steps(plain, cached, 6), steps(recorded, cached, 6)
    assert one == other
    assert len(set(one)) == 6
    assert recorded.step_number == 6
    for a, b in zip(plain.network.parameters(), recorded.network.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.usefixtures("small_network")
def test_a_cuda_graph_replays_training_steps(dataset: Path) -> None:
    gpu = torch.device("cuda")
    cached = cache_if_it_fits(loader(dataset), gpu)
    assert isinstance(cached, GpuDataset)
    recipe = replace(RECIPES["paper"], dropout=0.0, learning_rate=0.02)
    plain, recorded = (Trainer(recipe, (0.3, 0.2, 0.5), 1, gpu) for _ in range(2))
    assert isinstance(recorded.cuda_graph, CudaGraphStep)
    plain.cuda_graph = None
    assert steps(recorded, cached, 12) == pytest.approx(steps(plain, cached, 12), rel=2e-2)
    # The learning rate is not part of the graph: the same one goes on with another.
    graph = recorded.cuda_graph._replay
    before = [p.clone() for p in recorded.network.parameters()]
    recorded.recipe = plain.recipe = replace(recipe, learning_rate=0.01)
    assert steps(recorded, cached, 4) == pytest.approx(steps(plain, cached, 4), rel=2e-2)
    assert recorded.cuda_graph._replay is graph
    after = recorded.network.parameters()
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))

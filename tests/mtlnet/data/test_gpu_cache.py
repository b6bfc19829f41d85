"""Data kept where the network is, and a step that is recorded: the same batches, the same steps."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.data.gpu_cache import SHARE, DeviceBatch, GpuDataset, cache_if_it_fits
from mtlnet.data.loader import Loader
from mtlnet.training.cuda_graph import WARM_UP, CudaGraphStep
from mtlnet.training.loss import Losses
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
def test_resident_batches_are_the_loaders(dataset: Path, part: tuple[int, int]) -> None:
    made = loader(dataset, part=part)
    kept = GpuDataset(made, CPU)
    steps_over_the_end_of_an_epoch = range(5, 16)  # of 9 batches
    for step, batch in zip(steps_over_the_end_of_an_epoch, kept.batches(5), strict=False):
        expected = made.make(step)
        np.testing.assert_array_equal(batch.images.numpy(), expected.images)
        np.testing.assert_array_equal(batch.coded.numpy(), expected.coded)
        np.testing.assert_array_equal(batch.heading.numpy(), expected.heading)


def test_only_what_fits_and_is_not_changed_is_kept(dataset: Path) -> None:
    plain, changed = loader(dataset), loader(dataset, augment=True)
    size = len(plain.frames) * 210 * 280 * 3
    assert isinstance(cache_if_it_fits(plain, CPU, int(size / SHARE) + 1), GpuDataset)
    assert cache_if_it_fits(plain, CPU, int(size / SHARE) - 1) is plain
    assert cache_if_it_fits(changed, CPU, 100 * size) is changed
    assert cache_if_it_fits(plain, CPU) is plain  # a CPU keeps nothing


class Notebook:
    """Stands in for a GPU's recorder: what is recorded is done again when it is replayed."""

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


def test_a_recorded_step_sees_each_batch_in_the_same_memory() -> None:
    places: list[int] = []

    def work(batch: DeviceBatch) -> Losses:
        places.append(batch.coded.data_ptr())
        first = batch.coded[0]
        return Losses(first[0], first[1], first[2], first[3], first[:3])

    book = Notebook()
    step = CudaGraphStep(work, book)
    found = []
    for number in range(8):
        full = torch.full((2, 6), float(number))
        batch = DeviceBatch(torch.zeros(2, 1, 1, 3, dtype=torch.uint8), full, torch.zeros(2).long())
        found.append(step(batch, 0.1 if number < 6 else 0.09))
    assert len(set(places)) == 1
    assert (book.ran, book.replayed) == (WARM_UP, 8 - WARM_UP)
    assert book.recorded == 2  # and anew for another rate
    # What was given out stays as it was, though the memory it came from is used again.
    assert [float(losses.total) for losses in found[WARM_UP:]] == [3.0, 4.0, 5.0, 6.0, 7.0]


def steps(trainer: Trainer, kept: GpuDataset, count: int) -> list[float]:
    return [float(trainer.step(batch, 0.1).total) for batch in islice(kept.batches(0), count)]


@pytest.mark.usefixtures("small_network")
def test_recorded_training_is_training(dataset: Path) -> None:
    kept = GpuDataset(loader(dataset), CPU)
    recipe = replace(RECIPES["paper"], dropout=0.0, learning_rate=0.02)
    plain, recorded = (Trainer(recipe, (0.3, 0.2, 0.5), 1, CPU) for _ in range(2))
    recorded.captured = CudaGraphStep(recorded.learn, Notebook())
    one, other = steps(plain, kept, 6), steps(recorded, kept, 6)
    assert one == other
    assert len(set(one)) == 6
    assert recorded.step_number == 6
    for a, b in zip(plain.network.parameters(), recorded.network.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.usefixtures("small_network")
def test_a_gpu_replays_what_it_recorded(dataset: Path) -> None:
    gpu = torch.device("cuda")
    kept = cache_if_it_fits(loader(dataset), gpu)
    assert isinstance(kept, GpuDataset)
    recipe = replace(RECIPES["paper"], dropout=0.0, learning_rate=0.02)
    plain, recorded = (Trainer(recipe, (0.3, 0.2, 0.5), 1, gpu) for _ in range(2))
    assert isinstance(recorded.captured, CudaGraphStep)
    plain.captured = None
    assert steps(recorded, kept, 12) == pytest.approx(steps(plain, kept, 12), rel=2e-2)
    # With another rate it is recorded anew, and learns on.
    before = [p.clone() for p in recorded.network.parameters()]
    recorded.recipe = plain.recipe = replace(recipe, learning_rate=0.01)
    assert steps(recorded, kept, 4) == pytest.approx(steps(plain, kept, 4), rel=2e-2)
    after = recorded.network.parameters()
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))

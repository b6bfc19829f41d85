"""A cached dataset gives the loader's batches."""

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.data.gpu_cache import MEMORY_SHARE, GpuDataset, cache_if_it_fits
from mtlnet.data.loader import Loader
from trackfeatures.camera import CameraParameters

CPU = torch.device("cpu")
BATCH = 8


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

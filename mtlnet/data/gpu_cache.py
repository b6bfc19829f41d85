"""Keeps a dataset in GPU memory: images are decoded once, and each batch is selected from them.

The batches have the frames of the loader's batches (`mtlnet.data.loader`), in the same order. A
training step of the paper's network takes about 1 ms on a data-centre GPU, less than decoding or
augmenting 32 images on the CPU.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mtlnet.data.augment.on_device import DeviceAugment, to_device
from mtlnet.data.loader import Batch, BatchLabels, Loader, make_ahead

MEMORY_SHARE = 0.6
"""Maximum share of the free GPU memory for the images; the rest is for training."""
CHUNK = 256  # images decoded at once
DECODED_AHEAD = 3  # chunks decoded ahead while one is copied to the device
PREFETCH = 4  # batches whose labels are computed in advance


@dataclass(frozen=True)
class DeviceBatch:
    """A batch on the device: `images` uint8 (B, H, W, 3), coded targets `coded` (B, 6), classes
    `heading` (B,), and labels of the road ahead `ahead` (B, A). A is 28, or 0 without auxiliary
    heads."""

    images: Tensor
    coded: Tensor
    heading: Tensor
    ahead: Tensor = field(default_factory=lambda: torch.zeros(0, 0))


def on_device(batch: Batch | DeviceBatch, device: torch.device) -> DeviceBatch:
    """Copy the batch to `device` and return it as tensors. A DeviceBatch is returned unchanged."""
    if isinstance(batch, DeviceBatch):
        return batch
    arrays = (batch.images, batch.coded, batch.heading, batch.ahead)
    return DeviceBatch(*(to_device(each, device) for each in arrays))


class GpuDataset:
    """The frames of `loader` in the memory of `device`, and the loader's batches made from them.

    Rows above `first_row` are not stored. If the loader augments, augmentation runs on the device
    (`mtlnet.data.augment.on_device`); the labels are computed in advance on the CPU.
    """

    def __init__(self, loader: Loader, device: torch.device, first_row: int = 0) -> None:
        self._loader = loader
        self._device = device
        self._images = _decode(loader, device, first_row)
        self._augment = None
        if loader.augment:
            self._augment = DeviceAugment(loader.camera, first_row, device)
            return
        everything = np.arange(len(loader.heading))
        self._labels = [
            self._to_device(labels)
            for labels in (loader.coded, loader.heading, loader.read_ahead(everything))
        ]

    def make(self, step: int) -> DeviceBatch:
        """Return this process's part of batch number `step`."""
        if self._augment is not None:
            return self._augmented(self._loader.make_labels(step), step)
        rows = self._to_device(self._loader.indices(step)[self._loader.rows])
        return DeviceBatch(
            *(tensor.index_select(0, rows) for tensor in (self._images, *self._labels))
        )

    def batches(self, first: int) -> Iterator[DeviceBatch]:
        """Yield batches `first`, `first` + 1, ... without end."""
        if self._augment is None:
            return map(self.make, count(first))
        labels = make_ahead(self._loader.make_labels, first, PREFETCH, PREFETCH)
        return map(self._augmented, labels, count(first))

    def _augmented(self, labels: BatchLabels, step: int) -> DeviceBatch:
        assert self._augment is not None
        assert labels.params is not None
        images = self._images.index_select(0, self._to_device(labels.chosen))
        seed = int(np.random.SeedSequence([self._loader.seed, 4, step]).generate_state(1)[0])
        images = self._augment(images, labels.params, seed)
        arrays = (labels.coded, labels.heading, labels.ahead)
        return DeviceBatch(images, *(self._to_device(each) for each in arrays))

    def _to_device(self, values: NDArray[Any]) -> Tensor:
        return to_device(values, self._device)


def _decode(loader: Loader, device: torch.device, first_row: int) -> Tensor:
    camera, number = loader.camera, len(loader.frames)
    size = (camera.height, camera.width, 3)
    kept = (number, camera.height - first_row, *size[1:])
    images = torch.empty(kept, dtype=torch.uint8, device=device)

    def decode(chunk: int) -> NDArray[np.uint8]:
        rows = np.arange(number)[chunk * CHUNK : (chunk + 1) * CHUNK]
        return loader.frames.read_batch(rows, np.empty((len(rows), *size), np.uint8))

    firsts = range(0, number, CHUNK)
    # Two chunks are decoded at a time, so that all cores stay busy while one chunk ends.
    chunks = make_ahead(decode, 0, DECODED_AHEAD, 2)
    for first, chunk in zip(firsts, chunks, strict=False):
        images[first : first + len(chunk)] = torch.from_numpy(chunk[:, first_row:])
    chunks.close()
    return images


def cache_if_it_fits(
    loader: Loader, device: torch.device, free_bytes: int | None = None, first_row: int = 0
) -> Loader | GpuDataset:
    """Copy the loader's frames, image rows from `first_row` on, to the memory of `device`, and
    return them as a GpuDataset.

    Returns the loader itself if the frames do not fit, or if `device` is a CPU. `free_bytes`: free
    memory of the device; None: the amount that the device reports. The frames may take 60 % of it.
    """
    if free_bytes is None:
        free_bytes = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0
    rows = loader.camera.height - first_row
    if len(loader.frames) * rows * loader.camera.width * 3 > MEMORY_SHARE * free_bytes:
        return loader
    return GpuDataset(loader, device, first_row)

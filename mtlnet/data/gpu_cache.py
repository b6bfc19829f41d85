"""A dataset in GPU memory: decoded once, then each batch is an index into it.

The batches are those of the loader (`mtlnet.data.loader`), in its order. Only for recipes without
augmentation, which runs on the CPU. A training step of the paper's network takes a data-centre GPU
about a millisecond, less than decoding 32 images on the CPU.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mtlnet.data.loader import Batch, Loader

MEMORY_SHARE = 0.6
"""Largest share of the free GPU memory for the images; the rest is for training."""
CHUNK = 256  # images decoded at once


@dataclass(frozen=True)
class DeviceBatch:
    """A batch on the device: `images` (B, H, W, 3) uint8, `coded` (B, 6), `heading` (B,)."""

    images: Tensor
    coded: Tensor
    heading: Tensor


def on_device(batch: Batch | DeviceBatch, device: torch.device) -> DeviceBatch:
    """A batch as tensors on `device`."""
    if isinstance(batch, DeviceBatch):
        return batch
    arrays = (batch.images, batch.coded, batch.heading)
    return DeviceBatch(*(torch.from_numpy(a).to(device, non_blocking=True) for a in arrays))


class GpuDataset:
    """The frames of `loader` on `device`, and the loader's batches made from them."""

    def __init__(self, loader: Loader, device: torch.device) -> None:
        self._loader = loader
        self._device = device
        self._images = _decode(loader, device)
        self._coded = torch.from_numpy(loader.coded).to(device)
        self._heading = torch.from_numpy(loader.heading).to(device)

    def make(self, step: int) -> DeviceBatch:
        """This process's rows of batch `step`."""
        loader = self._loader
        rows = torch.from_numpy(loader.indices(step)[loader.rows])
        rows = rows.to(self._device, non_blocking=True)
        return DeviceBatch(
            *(tensor.index_select(0, rows) for tensor in (self._images, self._coded, self._heading))
        )

    def batches(self, first: int) -> Iterator[DeviceBatch]:
        """Batches `first`, `first` + 1, ... without end."""
        while True:
            yield self.make(first)
            first += 1


def _decode(loader: Loader, device: torch.device) -> Tensor:
    camera, count = loader.camera, len(loader.frames)
    size = (camera.height, camera.width, 3)
    images = torch.empty((count, *size), dtype=torch.uint8, device=device)
    chunk = np.empty((min(CHUNK, count), *size), np.uint8)
    for first in range(0, count, CHUNK):
        rows = np.arange(first, min(first + CHUNK, count))
        loader.frames.read_batch(rows, chunk[: len(rows)])
        images[first : first + len(rows)] = torch.from_numpy(chunk[: len(rows)])
    return images


def cache_if_it_fits(
    loader: Loader, device: torch.device, free_bytes: int | None = None
) -> Loader | GpuDataset:
    """The loader's frames on `device`; the loader itself if they do not fit or are augmented.

    `free_bytes`: free memory of the device, None: as it reports. On a CPU nothing is cached.
    """
    if free_bytes is None:
        free_bytes = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else 0
    needed = len(loader.frames) * loader.camera.height * loader.camera.width * 3
    if loader.augment or needed > MEMORY_SHARE * free_bytes:
        return loader
    return GpuDataset(loader, device)

"""Augments the images of a whole batch in torch, on a GPU.

Parameters and labels are the same as on the CPU (`mtlnet.data.augment.pipeline`). The images differ
as follows. Shift, rotation and mirroring are one resampling, so that each pixel is interpolated
once. Pixel values are rounded once, at the end. The noise is computed anew for each image; on the
CPU it is read from a stored array. There is no JPEG compression.
"""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, pad

from mtlnet.data.augment.geometric import (
    horizon_row,
    rotation_homography,
    rotations,
    shear_per_metre,
)
from mtlnet.data.augment.pipeline import AugmentParams
from mtlnet.data.augment.shadows import shadow_masks
from mtlnet.inference.rectification import BORDER_LEVEL
from trackfeatures.camera import CameraParameters

BLUR_RADIUS = 3


def to_device(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return the array as a tensor on `device`.

    It is copied to a GPU from pinned memory. A copy from pageable memory can wait for the kernels
    in the queue, and the GPU would then idle while the next batch is made.
    """
    tensor = torch.from_numpy(values)
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


class DeviceAugment:
    """Applies AugmentParams on `device` to images from which the rows above `first_row` were
    removed."""

    def __init__(self, camera: CameraParameters, first_row: int, device: torch.device) -> None:
        self._camera = camera
        self._first_row = first_row
        self._device = device
        ways = np.stack(
            [np.linalg.inv(rotation_homography(camera, *turn)) for turn in rotations().tolist()]
        )
        self._ways = torch.from_numpy(ways).float().to(device)
        self._shades = torch.from_numpy(shadow_masks(camera)[:, first_row:, :, :1].copy()).to(
            device
        )

    def __call__(self, images: Tensor, params: AugmentParams, seed: int) -> Tensor:
        """Return the augmented images, uint8 (B, h, W, 3), of `images`, uint8 (B, h, W, 3), with h
        the number of rows from `first_row` on. `seed`: the seed of the noise."""
        x = images.permute(0, 3, 1, 2).float()
        x = self._moved(x, params)
        shade = self._shades.index_select(0, self._on(params.shadow)).permute(0, 3, 1, 2)
        x = x * (shade.float() * (1 / 255))
        x = self._patched(x, params.patch)
        colour = self._on(params.colour)
        x = torch.einsum("bij,bjhw->bihw", colour[:, :, :3], x) + colour[:, :, 3, None, None]
        self._blur(x, params.blur_std)
        self._add_noise(x, params.noise_std, seed)
        x = self._with_border(x, params.border)
        return x.round_().clamp_(0, 255).to(torch.uint8).permute(0, 2, 3, 1)

    def _on(self, values: NDArray[np.generic]) -> Tensor:
        return to_device(values, self._device)

    def _moved(self, x: Tensor, params: AugmentParams) -> Tensor:
        """Return images `x` (B, 3, h, W) shifted, rotated and mirrored. Each pixel is resampled
        once."""
        _, _, height, width = x.shape
        rows = torch.arange(height, device=x.device, dtype=torch.float32) + self._first_row
        columns = torch.arange(width, device=x.device, dtype=torch.float32)
        mirrored = self._on(params.mirrored)[:, None, None]
        u = torch.where(mirrored, width - 1 - columns, columns).expand(-1, height, -1)
        v = rows[:, None].expand_as(u)
        way = self._ways.index_select(0, self._on(params.rotation))[:, :, :, None, None]
        u, v, scale = (way[:, i, 0] * u + way[:, i, 1] * v + way[:, i, 2] for i in range(3))
        u, v = u / scale, v / scale
        metres = self._on(params.shift).float()[:, None, None]
        below = (v - horizon_row(self._camera)).clamp_min(0)
        u = u - metres * shear_per_metre(self._camera) * below
        grid = torch.stack(
            [2 * u / (width - 1) - 1, 2 * (v - self._first_row) / (height - 1) - 1], 3
        )
        moved = grid_sample(x, grid, "bilinear", "reflection", align_corners=True)
        # The area that a shift brings into view gets the colour of the road, because mirrored
        # markings would bend back.
        bare = x[:, :, -1].mean(2)[:, :, None, None]
        beside = (metres != 0) & ((u < -0.5) | (u > width - 0.5))
        return torch.where(beside[:, None], bare, moved)

    def _patched(self, x: Tensor, patch: NDArray[np.int64]) -> Tensor:
        top, left, rows, columns, *colour = self._on(patch).unbind(1)
        row = torch.arange(x.shape[2], device=x.device) + self._first_row
        column = torch.arange(x.shape[3], device=x.device)
        down = (row >= top[:, None]) & (row < (top + rows)[:, None])
        across = (column >= left[:, None]) & (column < (left + columns)[:, None])
        inside = down[:, None, :, None] & across[:, None, None, :]
        return torch.where(inside, torch.stack(colour, 1).float()[:, :, None, None], x)

    def _with_border(self, x: Tensor, border: NDArray[np.int64]) -> Tensor:
        top, bottom, left, right = self._on(border).unbind(1)
        rows, columns = x.shape[2:]
        row = torch.arange(rows, device=x.device)
        column = torch.arange(columns, device=x.device)
        down = (row >= (top - self._first_row)[:, None]) & (row < (rows - bottom)[:, None])
        across = (column >= left[:, None]) & (column < (columns - right)[:, None])
        shown = down[:, None, :, None] & across[:, None, None, :]
        return torch.where(shown, x, float(BORDER_LEVEL))

    def _blur(self, x: Tensor, deviation: NDArray[np.float64]) -> None:
        chosen = np.flatnonzero(deviation)
        if not len(chosen):
            return
        rows = self._on(chosen)
        kernels = self._on(np.stack([blur_kernel(float(deviation[i])) for i in chosen]))
        kernels = kernels.repeat_interleave(3, 0)[:, None]
        part = x.index_select(0, rows)
        flat = part.reshape(1, -1, *part.shape[2:])
        for kernel, sides in (
            (kernels[:, :, None], (BLUR_RADIUS, BLUR_RADIUS, 0, 0)),
            (kernels[:, :, :, None], (0, 0, BLUR_RADIUS, BLUR_RADIUS)),
        ):
            flat = conv2d(pad(flat, sides, "reflect"), kernel, groups=len(kernels))
        x.index_copy_(0, rows, flat.reshape_as(part))

    def _add_noise(self, x: Tensor, deviation: NDArray[np.float64], seed: int) -> None:
        chosen = np.flatnonzero(deviation)
        if not len(chosen):
            return
        generator = torch.Generator(self._device).manual_seed(seed)
        shape = (len(chosen), *x.shape[1:])
        noise = torch.randn(shape, generator=generator, device=self._device)
        noise *= self._on(deviation[chosen]).float()[:, None, None, None]
        x.index_add_(0, self._on(chosen), noise)


@lru_cache(maxsize=4096)
def blur_kernel(deviation_px: float) -> NDArray[np.float32]:
    """Return the weights (7,) of a normal distribution with the standard deviation `deviation_px`,
    for the pixels -3 to 3. They are truncated as in OpenCV's blur, and their sum is 1."""
    away = np.arange(-BLUR_RADIUS, BLUR_RADIUS + 1)
    weight = np.exp(-0.5 * (away / deviation_px) ** 2) * (np.abs(away) <= round(2 * deviation_px))
    kernel: NDArray[np.float32] = (weight / weight.sum()).astype(np.float32)
    return kernel

"""Images augmented on the device look like those augmented on the CPU, and have the same labels."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.architecture import GRID
from mtlnet.data.augment.on_device import DeviceAugment
from mtlnet.data.augment.pipeline import AugmentParams, apply_params, draw_params
from mtlnet.data.gpu_cache import GpuDataset
from mtlnet.data.loader import Loader
from mtlnet.data.road_ahead import RoadAhead
from trackfeatures.camera import CameraParameters

CPU = torch.device("cpu")
ONE_BY_ONE: dict[str, Callable[[AugmentParams, AugmentParams], AugmentParams]] = {
    "shift": lambda none, drawn: replace(none, shift=drawn.shift),
    "rotation": lambda none, drawn: replace(none, rotation=drawn.rotation),
    "mirrored": lambda none, drawn: replace(none, mirrored=drawn.mirrored),
    "shadow": lambda none, drawn: replace(none, shadow=drawn.shadow),
    "patch": lambda none, drawn: replace(none, patch=drawn.patch),
    "colour": lambda none, drawn: replace(none, colour=drawn.colour),
    "blur_std": lambda none, drawn: replace(none, blur_std=drawn.blur_std),
    "border": lambda none, drawn: replace(none, border=drawn.border),
}


def drawn(count: int) -> tuple[AugmentParams, AugmentParams]:
    """Parameters that change nothing, and parameters that change every image."""
    params = draw_params(count, 210, 280, np.random.default_rng(2))
    some = replace(
        params,
        shift=np.linspace(-0.5, 0.5, count),
        rotation=np.arange(1, count + 1),
        shadow=np.arange(1, count + 1),
        blur_std=np.linspace(0.5, 1.4, count),
    )
    still = np.concatenate([np.eye(3), np.zeros((3, 1))], 1).astype(np.float32)
    none = replace(
        params,
        **{
            f: getattr(params, f) * 0
            for f in ("shift", "rotation", "shadow", "patch", "blur_std", "noise_std", "border")
        },
        mirrored=np.zeros(count, np.bool_),
        jpeg_quality=np.zeros(count, np.int64),
        colour=np.stack([still] * count),
    )
    return none, some


@pytest.mark.parametrize("name", list(ONE_BY_ONE))
def test_each_change_is_that_of_the_cpu(dataset: Path, name: str) -> None:
    frames = Dataset.open(dataset).select("train")
    images = frames.read_batch(np.arange(6))
    params = ONE_BY_ONE[name](*drawn(6))
    given = torch.from_numpy(images[:, 50:].copy())
    found = DeviceAugment(CameraParameters(), 50, CPU)(given, params, 0).numpy()[:, 20:].astype(int)
    apply_params(images, params, CameraParameters())
    off = np.abs(found - images[:, 70:].astype(int))
    # OpenCV interpolates in steps of 1/32 px, and rounds after each of its steps.
    assert np.median(off) <= 1
    assert (off > 16).mean() < (0.02 if name in ("shift", "rotation") else 0.001)


def test_noise_has_its_deviation_and_its_seed() -> None:
    none, _ = drawn(3)
    params = replace(none, noise_std=np.array([0.0, 4.0, 10.0]))
    augment = DeviceAugment(CameraParameters(), 66, CPU)
    grey = torch.full((3, 144, 280, 3), 128, dtype=torch.uint8)
    once, again, other = (augment(grey, params, seed).float() for seed in (1, 1, 2))
    assert torch.equal(once, again)
    assert not torch.equal(once, other)
    assert once.flatten(1).std(1).tolist() == pytest.approx([0.0, 4.0, 10.0], rel=0.02)


def test_resident_batches_have_the_loaders_labels(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("train")
    ahead = RoadAhead(frames, CameraParameters(), keep=True)
    loader = Loader(frames, CameraParameters(), 8, 3, augment=True, ahead=ahead)
    resident = GpuDataset(loader, CPU, GRID.first_row)
    for step, batch in enumerate(islice(resident.batches(0), 3)):
        expected = loader.make(step)
        assert tuple(batch.images.shape) == (8, 144, 280, 3)
        np.testing.assert_array_equal(batch.coded.numpy(), expected.coded)
        np.testing.assert_array_equal(batch.heading.numpy(), expected.heading)
        np.testing.assert_array_equal(batch.ahead.numpy(), expected.ahead)
        assert torch.equal(batch.images, resident.make(step).images)

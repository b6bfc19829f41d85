"""The loader: each frame once an epoch; batches are a function of seed and step."""

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from mtlnet.data.loader import Loader
from tests.datagen.recording.labels import labels_of
from trackfeatures.camera import CameraParameters


class FakeFrames:
    """Images whose pixels all have the value of the frame number."""

    def __init__(self, count: int) -> None:
        angle = np.linspace(-0.4, 0.4, count).astype(np.float32)
        distances = np.tile(np.array([-2, 2, np.nan, np.nan, np.nan], np.float32), (count, 1))
        self.labels = labels_of(
            count, distances=distances, angle=angle, heading=np.arange(count) % 3
        )

    def __len__(self) -> int:
        return len(self.labels.angle)

    def read_batch(self, indices: NDArray[np.int64], out: NDArray[np.uint8]) -> NDArray[np.uint8]:
        out[:] = np.asarray(indices, np.uint8)[:, None, None, None]
        return out


def loader(seed: int = 0, *, augment: bool = False, part: tuple[int, int] = (0, 1)) -> Loader:
    camera = CameraParameters(width=24, height=16)
    return Loader(FakeFrames(20), camera, 8, seed, augment=augment, part=part)


def test_each_frame_occurs_once_an_epoch() -> None:
    order = np.concatenate([loader().indices(step) for step in range(5)])
    assert sorted(order[:20]) == sorted(order[20:]) == list(range(20))
    assert order[:20].tolist() != order[20:].tolist()


def test_frames_that_are_repeated_occur_so_often_an_epoch() -> None:
    repeats = np.where(np.arange(20) % 4 == 0, 3, 1)
    camera = CameraParameters(width=24, height=16)
    source = Loader(FakeFrames(20), camera, 10, 0, augment=False, repeats=repeats)
    for epoch in (0, 1):
        order = np.concatenate([source.indices(3 * epoch + step) for step in range(3)])
        assert np.bincount(order, minlength=20).tolist() == repeats.tolist()


def test_batches_carry_the_labels_of_their_frames() -> None:
    source = loader()
    batches = source.batches(3)
    assert isinstance(batches, Generator)
    batch = next(batches)
    assert batch.images[:, 0, 0, 0].tolist() == source.indices(3).tolist()
    np.testing.assert_array_equal(batch.coded, source.coded[source.indices(3)])
    assert next(batches).images[:, 0, 0, 0].tolist() == source.indices(4).tolist()
    batches.close()


def test_batches_depend_only_on_seed_and_step() -> None:
    one, two = loader(augment=True).make(4), loader(augment=True).make(4)
    other = loader(seed=1, augment=True).make(4)
    np.testing.assert_array_equal(one.images, two.images)
    np.testing.assert_array_equal(one.coded, two.coded)
    assert one.images.tolist() != other.images.tolist()


def test_parts_of_a_batch_make_up_the_whole() -> None:
    whole = loader(augment=True).make(5)
    parts = [loader(augment=True, part=(which, 4)).make(5) for which in range(4)]
    for name in ("images", "coded", "heading"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))

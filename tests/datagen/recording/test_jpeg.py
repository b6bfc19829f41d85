"""Our decoder of recorded pictures against libjpeg-turbo's, bit by bit, and on damage."""

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from datagen.recording.bulk import MOST_HEADS, BulkDecoder, lots
from datagen.recording.jpeg.decoder import Decoder
from datagen.recording.jpeg.lot import Lot
from datagen.recording.jpeg.tables import OtherKindError, head_length, read_head
from datagen.recording.jpeg.vectors import take_next

Image = NDArray[np.uint8]


def scene(height: int, width: int, seed: int, noise: float) -> Image:
    """Smooth shades, sharp edges and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    shades = np.stack([x * 255 / width, y * 255 / height, (x + y) % 97 * 2.5], axis=-1)
    shades[height // 3 : height // 2, width // 4 : width // 2] = rng.integers(0, 256, 3)
    image = shades + rng.normal(0, noise, shades.shape)
    return np.asarray(image.clip(0, 255), dtype=np.uint8)


def encoded(image: Image, quality: int = 95, sampling: str = "420") -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", sampling))


def decoder_of(data: bytes) -> Decoder:
    return Decoder(data[: head_length(data)])


def in_bulk(images: list[bytes], threads: int = 1) -> tuple[Image, NDArray[np.bool_]]:
    """Pictures of 96 x 64, and which of them were decoded."""
    found, decoder = lots(images), BulkDecoder()
    out, done = np.zeros((len(images), 64, 96, 3), np.uint8), np.zeros(len(images), np.bool_)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda _: decoder.decode(found, out, done), range(threads)))
    return out, done


@numba.njit(nogil=True)
def all_taken(counter):  # type: ignore[no-untyped-def]
    found = [np.int64(0) for _ in range(0)]
    number = take_next(counter)
    while number < 1000:
        found.append(number)
        number = take_next(counter)
    return found


def turbo(data: bytes) -> Image:
    return np.asarray(simplejpeg.decode_jpeg(data, "RGB"))


@pytest.mark.parametrize("size", [(210, 280), (209, 282), (16, 32), (1, 48), (95, 650), (64, 64)])
def test_pictures_are_those_of_libjpeg_turbo(size: tuple[int, int]) -> None:
    for quality in (5, 50, 75, 90, 95, 100):
        for seed, noise in enumerate((0.0, 4.0, 60.0)):
            data = encoded(scene(*size, seed, noise), quality)
            out = np.empty((*size, 3), np.uint8)
            assert decoder_of(data).decode(data, out)
            np.testing.assert_array_equal(out, turbo(data))


@pytest.mark.parametrize("kind", ["uniform", "two", "lines"])
def test_the_noisiest_pictures_too(kind: str) -> None:
    """Every coefficient there is, so also the last of a block, and the longest codes."""
    rng = np.random.default_rng(7)
    if kind == "lines":
        image = np.zeros((210, 280, 3), np.uint8)
        image[:, ::2] = 255
        image[::3] ^= 255
    else:
        high = {"uniform": 256, "two": 2}[kind]
        image = (rng.integers(0, high, (210, 280, 3)) * (255 // (high - 1))).astype(np.uint8)
    for quality in (95, 98, 100):
        data = encoded(image, quality)
        out = np.empty_like(image)
        assert decoder_of(data).decode(data, out)
        np.testing.assert_array_equal(out, turbo(data))


def test_one_decoder_reads_one_picture_after_the_other() -> None:
    images = [encoded(scene(210, 280, seed, 3.0 * seed)) for seed in range(12)]
    decoder = decoder_of(images[0])
    out = np.empty((210, 280, 3), np.uint8)
    for data in [*images, *images[::-1]]:
        assert decoder.decode(data, out)
        np.testing.assert_array_equal(out, turbo(data))


def test_damage_is_seen_or_is_a_picture_as_libjpeg_turbo_sees_it() -> None:
    """500 pictures with a few other bytes: never out of bounds, never another picture than that of
    libjpeg-turbo where that has no complaint, and the next whole one is right."""
    whole = encoded(scene(64, 96, 1, 20.0))
    head = head_length(whole)
    decoder = Decoder(whole[:head])
    rng = np.random.default_rng(3)
    out, right = np.empty((64, 96, 3), np.uint8), turbo(whole)
    refused = 0
    for _ in range(500):
        damaged = bytearray(whole)
        for place in rng.integers(head, len(whole), rng.integers(1, 4)):
            damaged[place] = rng.integers(0, 256)
        if decoder.decode(bytes(damaged), out):
            try:
                expected = simplejpeg.decode_jpeg(bytes(damaged), "RGB")
            except ValueError:
                continue
            assert np.mean(out != expected) < 0.02  # sums beyond 16 bits are cut, there saturated
        else:
            refused += 1
        assert decoder.decode(whole, out)
        np.testing.assert_array_equal(out, right)
    assert refused > 100


def test_a_cut_picture_is_refused() -> None:
    whole = encoded(scene(64, 96, 1, 20.0))
    head = head_length(whole)
    decoder = Decoder(whole[:head])
    out = np.empty((64, 96, 3), np.uint8)
    for length in range(head, len(whole), 7):
        assert not decoder.decode(whole[:length], out)
        assert not decoder.decode(whole[:length] + b"\xff\xd9", out)


def test_other_kinds_are_left_to_the_general_decoder() -> None:
    image = scene(64, 96, 2, 5.0)
    for sampling in ("444", "422"):
        data = encoded(image, 90, sampling)
        with pytest.raises(OtherKindError):
            decoder_of(data)
        _, done = in_bulk([data])
        assert not done[0]
    odd = encoded(scene(64, 97, 2, 5.0))
    with pytest.raises(OtherKindError, match="97x64"):
        decoder_of(odd)


@pytest.mark.parametrize("cut", range(2, 600, 13))
def test_a_damaged_head_is_refused(cut: int) -> None:
    data = encoded(scene(64, 96, 2, 5.0))
    head = data[: head_length(data)]
    with pytest.raises(OtherKindError):
        read_head(head[:cut])


def test_a_lot_is_shared_by_threads_and_damage_in_it_hurts_no_neighbour() -> None:
    """Two qualities, so two lots; cut, foreign and empty pictures are left to the general one."""
    images = [encoded(scene(64, 96, s, 9.0), 90 + 5 * (s % 2)) for s in range(64)]
    strange = {5: images[5][:-400], 6: b"", 7: encoded(scene(64, 96, 7, 9.0), 95, "444"), 40: b"?"}
    for row, data in strange.items():
        images[row] = data
    for threads in (1, 2, 5):
        out, done = in_bulk(images, threads)
        assert np.flatnonzero(~done).tolist() == sorted(strange)
        for row in np.flatnonzero(done).tolist():
            np.testing.assert_array_equal(out[row], turbo(images[row]))


def test_no_picture_of_a_lot_is_decoded_twice() -> None:
    lot = Lot.of(b"", range(1000), [b"x"] * 1000)
    taken: list[int] = []
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: taken.extend(all_taken(lot.taken)), range(4)))
    assert sorted(taken) == list(range(1000))


def test_decoders_are_kept_for_few_heads_only() -> None:
    images = [encoded(scene(64, 96, 1, 5.0), quality) for quality in range(90, 90 + MOST_HEADS)]
    images += [encoded(scene(64, 96, 1, 5.0), quality) for quality in range(40, 50)]
    _, done = in_bulk(images)
    assert done.tolist() == [True] * MOST_HEADS + [False] * (len(images) - MOST_HEADS)


def test_pictures_of_another_size_than_the_batch_are_left_alone() -> None:
    decoder = BulkDecoder()
    found, out = lots([encoded(scene(64, 96, 1, 5.0))]), np.zeros((1, 32, 32, 3), np.uint8)
    done = np.zeros(1, np.bool_)
    decoder.decode(found, out, done)
    assert not done[0]
    assert not out.any()

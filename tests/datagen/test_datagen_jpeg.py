"""Our decoder of recorded pictures against libjpeg-turbo's, bit by bit, and on damage."""

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from datagen.recording.bulk import BulkDecoder
from datagen.recording.encoding import decode_into
from datagen.recording.jpeg.decoder import Decoder
from datagen.recording.jpeg.tables import OtherKindError, head_length, read_head

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
        out = np.empty_like(image)
        BulkDecoder().decode_into(data, out)
        np.testing.assert_array_equal(out, turbo(data))
    odd = encoded(scene(64, 97, 2, 5.0))
    with pytest.raises(OtherKindError, match="97x64"):
        decoder_of(odd)


@pytest.mark.parametrize("cut", range(2, 600, 13))
def test_a_damaged_head_is_refused(cut: int) -> None:
    data = encoded(scene(64, 96, 2, 5.0))
    head = data[: head_length(data)]
    with pytest.raises(OtherKindError):
        read_head(head[:cut])


def test_bulk_answers_and_complains_as_the_general_decoder() -> None:
    bulk = BulkDecoder()
    images = [
        encoded(scene(64, 96, s, 5.0), quality) for s in range(3) for quality in range(88, 100)
    ]
    out, expected = np.empty((64, 96, 3), np.uint8), np.empty((64, 96, 3), np.uint8)
    for data in images:  # more heads than it keeps decoders
        bulk.decode_into(memoryview(data), out)
        decode_into(data, expected)
        np.testing.assert_array_equal(out, expected)
    with pytest.raises(ValueError, match=r"."):
        bulk.decode_into(images[0][:-400], out)
    with pytest.raises(ValueError, match="96x64 px where 32x32"):
        bulk.decode_into(images[0], np.empty((32, 32, 3), np.uint8))
    with pytest.raises(ValueError, match="neither JPEG nor PNG"):
        bulk.decode_into(b"", out)

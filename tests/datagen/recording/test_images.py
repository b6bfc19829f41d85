"""Encoding and decoding of single images: sizes, kinds of JPEG, and damaged bytes."""

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from datagen.recording.images import decode_into, encode
from datagen.recording.round_metadata import RoundHeader

Image = NDArray[np.uint8]


def make_image(height: int, width: int, seed: int, noise: float) -> Image:
    """Smooth gradients, sharp edges and noise, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    shades = np.stack([x * 255 / width, y * 255 / height, (x + y) % 97 * 2.5], axis=-1)
    shades[height // 3 : height // 2, width // 4 : width // 2] = rng.integers(0, 256, 3)
    image = shades + rng.normal(0, noise, shades.shape)
    return np.asarray(image.clip(0, 255), dtype=np.uint8)


@pytest.mark.parametrize("size", [(210, 280), (209, 282), (16, 32), (1, 48), (95, 650), (64, 97)])
@pytest.mark.parametrize("sampling", ["420", "422", "444"])
def test_every_kind_of_jpeg_decodes_as_libjpeg_turbo_does(
    size: tuple[int, int], sampling: str
) -> None:
    for quality in (5, 75, 95, 100):
        data = simplejpeg.encode_jpeg(make_image(*size, quality, 20.0), quality, "RGB", sampling)
        out = np.empty((*size, 3), np.uint8)
        decode_into(memoryview(data), out)
        np.testing.assert_array_equal(out, simplejpeg.decode_jpeg(data, "RGB"))


def test_png_is_lossless_and_jpeg_stays_within_4_of_255() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (42, 56, 3), dtype=np.uint8)
    out = np.empty_like(image)
    decode_into(encode(image, "png"), out)
    assert np.array_equal(out, image)
    smooth = np.tile(np.arange(56, dtype=np.uint8)[None, :, None] * 4, (42, 1, 3))
    decode_into(encode(smooth, "jpeg"), out)
    assert np.abs(out.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize("codec", ["jpeg", "png"])
def test_a_truncated_image_is_refused(codec: str) -> None:
    whole = encode(make_image(64, 96, 1, 20.0), codec)
    out = np.empty((64, 96, 3), np.uint8)
    for length in [*range(0, len(whole) - 12, 37), len(whole) - 12]:
        with pytest.raises(ValueError, match=r"\w"):
            decode_into(whole[:length], out)
    decode_into(whole, out)


def test_changed_bytes_never_write_outside_the_image() -> None:
    """500 JPEG images with one to three changed bytes in or after the header.

    Each is refused or decoded; the bytes before and after `out` stay, and the next good image is
    decoded correctly.
    """
    whole = encode(make_image(64, 96, 1, 20.0), "jpeg")
    expected = simplejpeg.decode_jpeg(whole, "RGB")
    memory = np.full((3, 64, 96, 3), 7, np.uint8)
    out = memory[1]
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(500):
        damaged = bytearray(whole)
        for at in rng.integers(2, len(whole), rng.integers(1, 4)):
            damaged[at] = rng.integers(0, 256)
        try:
            decode_into(bytes(damaged), out)
        except ValueError:
            refused += 1
        decode_into(whole, out)
        np.testing.assert_array_equal(out, expected)
    assert (memory[[0, 2]] == 7).all()
    assert refused > 50


def test_an_image_of_another_size_is_refused() -> None:
    for codec in ("jpeg", "png"):
        small = encode(np.zeros((20, 20, 3), np.uint8), codec)
        with pytest.raises(ValueError, match="20x20 px, expected 56x42 px"):
            decode_into(small, np.empty((42, 56, 3), np.uint8))


def test_bytes_that_are_no_image_are_refused() -> None:
    with pytest.raises(ValueError, match="neither JPEG nor PNG: it starts with b'GIF8'"):
        decode_into(b"GIF89a", np.empty((42, 56, 3), np.uint8))


@pytest.mark.parametrize("size", [(65534, 65534), (0, 0), (640, 479)])
def test_a_png_is_not_decoded_unless_its_header_has_the_size_of_the_round(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = np.zeros((480, 640, 3), np.uint8)
    data = bytearray(encode(out, "png"))
    data[16:24] = struct.pack(">II", *size)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    monkeypatch.setattr("cv2.imdecode", None)  # it would allocate 12 GB
    with pytest.raises(ValueError, match=f"it is {size[0]}x{size[1]} px, expected 640x480"):
        decode_into(bytes(data), out)
    with pytest.raises(ValueError, match="ends within its header"):
        decode_into(bytes(data[:20]), out)
    header = RoundHeader("a", 1, "oval", "", 1, 4.0, 0, "centre", ("clear",), 50.0)
    header.validate()
    camera = replace(header.camera, width=size[0], height=size[0])
    if size[0] != 640:
        with pytest.raises(ValueError, match="its header has an image size of"):
            replace(header, camera=camera).validate()


def test_an_unknown_codec_is_an_error() -> None:
    with pytest.raises(ValueError, match="codec 'webp', not jpeg or png"):
        encode(np.zeros((2, 2, 3), np.uint8), "webp")

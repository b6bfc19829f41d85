"""Image decoding: accepted images and their pixels, refused images and their faults."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import simplejpeg

from mtlnet.inference.image_decoding.crop import Box, crop_box
from mtlnet.inference.image_decoding.decode import (
    LATE_CHECK_BYTES,
    crop_and_resize,
    decode_whole,
    read_header,
)
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.image_decoding.jpeg_structure import read_head, read_structure
from tests.mtlnet.inference.images import chunk, jpeg, picture, png
from trackfeatures.camera import CameraParameters

VIEW = CameraParameters()


def pixels(body: bytes) -> np.ndarray:
    return crop_and_resize(decode_whole(body, read_header(body)), VIEW)


def refusal(body: bytes) -> ImageError:
    with pytest.raises(ImageError) as caught:
        pixels(body)
    return caught.value


def handmade_png(
    width: int = 280,
    height: int = 210,
    rows: bytes | None = None,
    *,
    depth: int = 8,
    colour: int = 2,
    interlace: int = 0,
    extra: bytes = b"",
) -> bytes:
    if rows is None:
        rows = (b"\0" + b"\x40\x80\xc0" * width) * height
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_a_jpeg_of_the_cameras_size_gives_the_decoders_pixels() -> None:
    body = jpeg(picture())
    assert np.array_equal(pixels(body), simplejpeg.decode_jpeg(body))


def test_a_png_gives_its_exact_pixels_in_rgb() -> None:
    image = picture()
    assert np.array_equal(pixels(png(image[:, :, ::-1])), image)


@pytest.mark.parametrize("body", [jpeg(picture()[:, :, :1], "GRAY"), png(picture()[:, :, 0])])
def test_grey_becomes_rgb(body: bytes) -> None:
    image = pixels(body)
    assert image.shape == (210, 280, 3)
    assert np.abs(image.astype(int) - picture()[:, :, :1]).max() <= 3


def test_alpha_is_dropped() -> None:
    image = picture(channels=4)
    assert np.array_equal(pixels(png(image))[:, :, ::-1], image[:, :, :3])


def test_sixteen_bits_become_the_upper_eight() -> None:
    image = (picture().astype(np.uint16) << 8) + 17
    assert np.array_equal(pixels(png(image))[:, :, ::-1], picture())


def test_one_bit_palette_and_interlaced_images_are_read() -> None:
    row = b"\0" + b"\xff" * 35
    assert (pixels(handmade_png(rows=row * 210, depth=1, colour=0)) == 255).all()
    palette = chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))
    indexed = handmade_png(rows=row * 210, depth=1, colour=3, extra=palette)
    assert (pixels(indexed) == (40, 50, 60)).all()
    # Adam7 of 280 x 210: (columns, rows) of the seven passes.
    sizes = [(35, 27), (35, 27), (70, 26), (70, 53), (140, 52), (140, 105), (280, 105)]
    rows = b"".join((b"\0" + b"\x40\x80\xc0" * columns) * count for columns, count in sizes)
    assert (pixels(handmade_png(rows=rows, interlace=1)) == (0x40, 0x80, 0xC0)).all()


def test_another_size_of_the_same_shape_is_area_averaged() -> None:
    large = picture(1120, 840)
    mean = large.reshape(210, 4, 280, 4, 3).mean(axis=(1, 3))
    assert np.abs(pixels(png(large[:, :, ::-1])) - mean).max() <= 1.0
    assert pixels(jpeg(picture(140, 105))).shape == (210, 280, 3)


def test_an_animation_is_read_as_its_first_picture() -> None:
    marked = handmade_png(extra=chunk(b"acTL", bytes(8)))
    assert np.array_equal(pixels(marked), pixels(handmade_png()))


def test_aspect_ratios_within_1_percent_pass_and_others_are_cropped_or_refused() -> None:
    assert pixels(jpeg(picture(278, 210))).shape == (210, 280, 3)
    error = refusal(jpeg(picture(276, 210)))
    assert error.fault is Fault.ASPECT
    assert "276 x 210" in str(error)
    assert "280 x 210" in str(error)
    wide = picture(480, 210)
    assert np.array_equal(pixels(png(wide[:, :, ::-1])), wide[:, 100:380])


def test_a_wider_field_of_view_is_cropped_and_a_narrower_one_refused() -> None:
    """tan(67.5 / 2 deg) = 0.66818 of tan(45 deg): 210 rows seen with 67.5 are 314.3 with 90."""
    large = picture(420, 314)
    body = png(large[:, :, ::-1])
    header = read_header(body)
    assert np.array_equal(
        crop_and_resize(decode_whole(body, header), VIEW, 90.0), large[52:262, 70:350]
    )
    assert crop_box(420, 314, VIEW, 90.0) == Box(70, 52, 280, 210)
    with pytest.raises(ImageError, match="50 degrees") as caught:
        crop_box(420, 314, VIEW, 50.0)
    assert caught.value.fault is Fault.FIELD_OF_VIEW


def test_up_to_64_trailing_bytes_are_accepted() -> None:
    for body in (JPEG, PNG):
        assert np.array_equal(pixels(body + bytes(64)), pixels(body))
        error = refusal(body + JPEG)
        assert error.fault is Fault.TRAILING
        assert f"{len(JPEG)} bytes" in str(error)
        assert refusal(body + bytes(65)).fault is Fault.TRAILING


def test_a_progressive_jpeg_and_fill_bytes_are_read() -> None:
    image = picture()
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    body = cv2.imencode(".jpg", image, options)[1].tobytes()
    assert read_structure(body).length == len(body)
    filled = body[:2] + b"\xff" * 5 + body[2:]
    assert np.array_equal(pixels(filled), pixels(body))


def test_the_size_of_a_large_jpeg_is_read_without_its_profile_and_tables() -> None:
    body = jpeg(picture(400, 210))
    more = b"".join(
        struct.pack(">BBH", 0xFF, marker, 60_002) + bytes(60_000)
        for marker in (0xE1, 0xE2, 0xED, 0xFE, 0xC4, 0xDB)
    )
    large = body[:2] + more + b"\xff\xff" + body[2:]
    assert len(large) > LATE_CHECK_BYTES
    description = read_head(large).description
    assert len(description) < 100
    assert simplejpeg.decode_jpeg_header(description) == simplejpeg.decode_jpeg_header(body)
    header = read_header(large)
    assert (header.width, header.height, header.checked) == (400, 210, False)
    assert read_head(body[:2] + b"\xff\xd9").description == b"\xff\xd8\xff\xd9"


JPEG, PNG = jpeg(picture()), png(picture())


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        (b"", Fault.NOT_AN_IMAGE),
        (b"hello, this is text", Fault.NOT_AN_IMAGE),
        (b"GIF89a" + bytes(50), Fault.NOT_AN_IMAGE),
        (JPEG[:4], Fault.DAMAGED),
        (JPEG[:-1], Fault.DAMAGED),
        (JPEG[: len(JPEG) // 2], Fault.DAMAGED),
        (PNG[:10], Fault.DAMAGED),
        (PNG[:-1], Fault.DAMAGED),
        (PNG[: len(PNG) // 2], Fault.DAMAGED),
        (PNG[:200] + b"\x55\xaa" + PNG[202:], Fault.DAMAGED),
        (handmade_png(rows=bytes(10)), Fault.DAMAGED),
        (handmade_png(rows=bytes(211 * 841)), Fault.DAMAGED),
        (handmade_png(rows=(b"\x05" + bytes(840)) * 210), Fault.DAMAGED),
        (handmade_png(extra=chunk(b"ABCD", b"")), Fault.UNSUPPORTED),
        (handmade_png(extra=chunk(b"abCd", b"") * 10_000), Fault.UNSUPPORTED),
        (handmade_png(depth=3), Fault.UNSUPPORTED),
        (handmade_png(interlace=2), Fault.UNSUPPORTED),
        (JPEG[:-2] + b"\xff\xda\0\x02" * 101, Fault.UNSUPPORTED),
        (bytes(simplejpeg.encode_jpeg(picture(channels=4), 95, "CMYK")), Fault.UNSUPPORTED),
        (jpeg(picture(12, 9)), Fault.SIZE),
        (handmade_png(0, 0, rows=b""), Fault.SIZE),
        (handmade_png(2**32 - 1, 2**32 - 1, rows=b""), Fault.SIZE),
    ],
)
def test_a_bad_image_is_refused_with_its_fault(body: bytes, fault: Fault) -> None:
    error = refusal(body)
    assert error.fault is fault
    assert str(error)


@pytest.mark.parametrize("size", [(4104, 3078), (3600, 2700)])
def test_an_image_with_too_many_pixels_is_refused(size: tuple[int, int]) -> None:
    assert refusal(jpeg(picture(*size))).fault is Fault.SIZE


def test_a_decompression_bomb_is_refused_by_its_header(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    bomb = handmade_png(16000, 16000, rows=bytes(1 + 48000) * 200)
    error = refusal(bomb)
    assert error.fault is Fault.SIZE
    assert "16000 x 16000" in str(error)


def test_pixels_beyond_the_headers_size_are_not_inflated() -> None:
    """A PNG whose header is small but whose pixels inflate to 1 GB: refused without the memory."""
    import tracemalloc

    data = zlib.compressobj(9)
    bomb_rows = b"".join(data.compress(bytes(2**20)) for _ in range(256)) + data.flush()
    bomb = handmade_png(rows=b"")
    plain = chunk(b"IDAT", zlib.compress(b""))
    body = bomb.replace(plain, chunk(b"IDAT", bomb_rows))
    tracemalloc.start()
    assert refusal(body).fault is Fault.DAMAGED
    assert tracemalloc.get_traced_memory()[1] < 4e6
    tracemalloc.stop()

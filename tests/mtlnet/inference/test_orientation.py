"""Orientation: all paths give the pixels of the same picture stored upright. The expected rotations
are numpy's, after the table of TIFF 6.0; ours are OpenCV's."""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import simplejpeg

from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.decode import (
    LATE_CHECK_BYTES,
    crop_and_resize,
    decode_whole,
    read_header,
    read_whole_image,
)
from mtlnet.inference.image_decoding.orientation import exif_orientation, read_tags
from mtlnet.inference.rectification import Rectification
from tests.mtlnet.inference.images import Pixels, exif, in_jpeg, in_png, segment
from trackfeatures.camera import CameraParameters

VIEW = CameraParameters()


TURNS: dict[int, Callable[[Pixels], Pixels]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: image[::-1, ::-1].transpose(1, 0, 2),
    8: lambda image: np.rot90(image),
}
"""Correction of the stored image, by orientation."""
BACK = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
ALL = range(1, 9)


def by_opencv(suffix: str, image: Pixels, block: bytes) -> bytes:
    """An AVIF written with this Exif block; libavif converts its orientation to `irot` and
    `imir`."""
    done, body = cv2.imencodeWithMetadata(
        suffix,
        np.ascontiguousarray(image[:, :, ::-1]),
        [cv2.IMAGE_METADATA_EXIF],
        [np.frombuffer(block, np.uint8)],
    )
    assert done
    return bytes(body.tobytes())


def in_tiff(image: Pixels, orientation: int) -> bytes:
    """An uncompressed TIFF."""
    high, wide = image.shape[:2]
    entries = [
        *((256, 4, 1, wide), (257, 4, 1, high), (258, 3, 3, 8 + 2 + 12 * 9 + 4), (259, 3, 1, 1)),
        *((262, 3, 1, 2), (273, 4, 1, 200), (274, 3, 1, orientation), (277, 3, 1, 3)),
        (279, 4, 1, image.size),
    ]
    head = b"II" + struct.pack("<HIH", 42, 8, len(entries))
    head += b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    return (head + struct.pack("<HHH", 8, 8, 8)).ljust(200, b"\0") + image.tobytes()


def picture(width: int = 300, height: int = 210) -> Pixels:
    """A smooth image that differs from all its rotations and mirror images."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    planes = [255 * x, 255 * y * y, 180 * x * (1 - y)]
    return np.stack(planes, axis=2).astype(np.uint8)


def stored(orientation: int, image: Pixels | None = None) -> Pixels:
    """The stored image that is `image` when upright."""
    upright = picture() if image is None else image
    return np.ascontiguousarray(TURNS[BACK[orientation]](upright))


def by_service(body: bytes) -> Pixels:
    return crop_and_resize(decode_whole(body, read_header(body)), VIEW)


@pytest.mark.parametrize("orientation", ALL)
def test_a_turned_jpeg_and_png_give_the_pixels_of_the_upright_one(
    orientation: int, tmp_path: Path
) -> None:
    """In the service and locally, for an image that is wider than the view and so cropped, in both
    byte orders."""
    expected = crop_and_resize(picture(), VIEW)
    image, path = stored(orientation), tmp_path / "a"
    for order in "<>":
        block = exif(orientation, order)
        for body in (in_png(image, block), in_png(image, block, at_end=True)):
            path.write_bytes(body)
            assert np.array_equal(by_service(body), expected)
            assert np.array_equal(crop_and_resize(read_whole_image(path), VIEW), expected)
            assert np.array_equal(read_whole_image(path), picture())
        body = in_jpeg(image, block)
        path.write_bytes(body)
        whole = TURNS[orientation](simplejpeg.decode_jpeg(body))
        assert np.abs(whole.astype(int) - picture()).mean() < 2
        assert np.array_equal(by_service(body), crop_and_resize(whole, VIEW))
        assert np.array_equal(
            crop_and_resize(read_whole_image(path), VIEW), crop_and_resize(whole, VIEW)
        )
        assert np.array_equal(read_whole_image(path), whole)


@pytest.mark.parametrize("orientation", ALL)
def test_other_kinds_of_files_are_turned_alike(orientation: int, tmp_path: Path) -> None:
    image, block, path = stored(orientation), exif(orientation), tmp_path / "a"
    bodies = [by_opencv(suffix, image, block) for suffix in (".webp", ".avif", ".png", ".jpg")]
    for body in (*bodies, in_tiff(image, orientation)):
        path.write_bytes(body)
        found = read_whole_image(path)
        assert found.shape == (210, 300, 3)
        assert np.abs(found.astype(int) - picture()).mean() < 3


@pytest.mark.parametrize("orientation", [1, 3, 5, 6, 8])
def test_sizes_and_crops_are_those_of_the_upright_image(orientation: int) -> None:
    image = picture(640, 300)
    for body in (
        in_png(stored(orientation, image), exif(orientation)),
        in_jpeg(stored(orientation, image), exif(orientation)),
    ):
        header = read_header(body)
        assert (header.width, header.height) == (640, 300)
        assert crop_box(header.width, header.height, VIEW) is not None


def test_a_large_jpeg_is_turned_too() -> None:
    """Above this size the structure is read again, by other code."""
    noise = np.random.default_rng(1).integers(0, 256, (600, 800, 3), np.uint8)
    body = in_jpeg(stored(6, noise), exif(6))
    assert len(body) > LATE_CHECK_BYTES
    header = read_header(body)
    assert (header.width, header.height, header.orientation) == (800, 600, 6)
    assert header.decode_ms == pytest.approx(800 * 600 * (10 + 6) / 1e6)
    whole = np.rot90(simplejpeg.decode_jpeg(body), -1)
    assert np.array_equal(by_service(body), crop_and_resize(whole, VIEW))


def test_exif_is_found_behind_other_segments_and_the_first_one_counts() -> None:
    xmp = segment(b"http://ns.adobe.com/xap/1.0/\0<x tiff:Orientation='8'/>")
    image = picture()
    for before in (
        [segment(b"JFIF\0\1\1\0\0\1\0\1\0\0", 0xE0)],
        [xmp, segment(b"ICC_PROFILE\0\1\1" + bytes(3000), 0xE2)],
        [segment(b"a comment", 0xFE)] * 5,
        [b"\xff\xff\xff", xmp],  # fill bytes
    ):
        assert read_header(in_jpeg(image, exif(3), *before)).orientation == 3
    twice = in_jpeg(image, exif(6), segment(b"Exif\0\0" + exif(3)))
    assert read_header(twice).orientation == 3
    assert read_header(in_jpeg(image, b"", xmp)).orientation == 1  # XMP is not read


@pytest.mark.parametrize(
    "block",
    [
        b"",
        b"MM",
        b"XX\0\x2a\0\0\0\x08",
        b"MM\0\x2a\xff\xff\xff\xff",
        b"MM\0\x2a\0\0\0\x08\xff\xff",
        b"II\x2b\0\x08\0\0\0\xff\xff\xff\xff\xff\xff\xff\xff" + bytes(40),
        exif(3)[:30],
        exif(0),
        exif(9),
        exif(65535),
        exif(3, kind=4),  # LONG
        exif(3, kind=2),  # ASCII
        exif(3, count=2),
        bytes(500),
    ],
)
def test_a_broken_orientation_counts_as_none(block: bytes) -> None:
    assert exif_orientation(block) == 1
    expected = crop_and_resize(picture(), VIEW)
    assert np.array_equal(by_service(in_png(picture(), block)), expected)
    assert read_header(in_jpeg(picture(), block)).orientation == 1


def test_only_the_first_directory_is_read() -> None:
    """The orientation of the thumbnail is not used; of many entries at most a thousand are read."""
    alone = b"MM" + struct.pack(">HIHI", 42, 8, 0, 14)
    alone += struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    assert exif_orientation(alone) == 1
    endless = b"MM" + struct.pack(">HIH", 42, 8, 65535)
    endless += b"".join(struct.pack(">HHIHH", tag, 3, 1, 6, 0) for tag in range(0x8000, 0xF000))
    assert len(read_tags(endless)) == 1000


def test_rectification_sees_the_upright_image(tmp_path: Path) -> None:
    camera = CameraParameters(width=640, height=360, fov_y_deg=50.0)
    image = picture(640, 360)
    path = tmp_path / "a.png"
    path.write_bytes(in_png(stored(6, image), exif(6)))
    lens = Rectification(camera, VIEW)
    assert np.array_equal(lens.image(read_whole_image(path)), lens.image(image))

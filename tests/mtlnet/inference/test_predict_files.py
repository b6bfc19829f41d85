"""Image files of this machine: the same pixels as in the service, more kinds, fewer limits."""

import os
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg

from mtlnet.inference.image_decoding.decode import (
    crop_and_resize,
    decode_whole,
    read_header,
    read_whole_image,
)
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from tests.mtlnet.inference.images import chunk
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

VIEW = CameraParameters()
NOISE = np.random.default_rng(3).integers(0, 256, (210, 280, 3), np.uint8)
JPEG: bytes = simplejpeg.encode_jpeg(NOISE, 90)
PNG = cv2.imencode(".png", NOISE)[1].tobytes()


def fault(path: Path) -> Fault:
    with pytest.raises(ImageError, match=path.name) as caught:
        read_whole_image(path)
    return caught.value.fault


def test_a_file_gives_the_same_pixels_as_in_the_service(tmp_path: Path) -> None:
    """Also a smaller image, and one whose name is not UTF-8."""
    small = simplejpeg.encode_jpeg(np.ascontiguousarray(NOISE[:105, :140]), 90)
    for body in (JPEG, PNG, small):
        path = tmp_path / os.fsdecode(b"caf\xe9.jpg")
        path.write_bytes(body)
        assert np.array_equal(read_whole_image(path), decode_whole(body, read_header(body)))


def test_a_missing_and_a_too_large_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no image file"):
        read_whole_image(tmp_path / "none.jpg")
    with (tmp_path / "huge.jpg").open("wb") as file:
        file.truncate((1 << 30) + 1)
    with pytest.raises(UserError, match=r"huge\.jpg has 1073741825 bytes"):
        read_whole_image(tmp_path / "huge.jpg")


SMOOTH = cv2.resize(NOISE[:7, :9], (280, 210), interpolation=cv2.INTER_CUBIC).astype(np.uint8)


def encoded(suffix: str, image: Any = SMOOTH, *options: int) -> bytes:
    """`image` in OpenCV's channel order (BGR, BGRA or grey)."""
    done, body = cv2.imencode(suffix, image, list(options))
    assert done
    return bytes(body.tobytes())


@pytest.mark.parametrize(
    ("body", "tolerance"),
    [
        (encoded(".webp", SMOOTH, cv2.IMWRITE_WEBP_QUALITY, 101), 0.0),
        (encoded(".webp", SMOOTH, cv2.IMWRITE_WEBP_QUALITY, 95), 3.0),
        (encoded(".bmp"), 0.0),
        (encoded(".tif"), 0.0),
        (encoded(".tif", SMOOTH.astype(np.uint16) * 257), 0.0),
        (encoded(".tif", np.dstack([SMOOTH, SMOOTH[:, :, 0]])), 0.0),
        (encoded(".avif", SMOOTH, cv2.IMWRITE_AVIF_QUALITY, 95), 3.0),
        (
            encoded(
                ".avif",
                SMOOTH.astype(np.uint16) * 4,
                *(cv2.IMWRITE_AVIF_QUALITY, 95, cv2.IMWRITE_AVIF_DEPTH, 10),
            ),
            3.0,
        ),
        (encoded(".gif"), 20.0),
        (encoded(".ppm"), 0.0),
        (encoded(".png", np.dstack([SMOOTH, SMOOTH[:, :, 0]])), 0.0),
        (encoded(".bmp") + bytes(500), 0.0),
    ],
    ids=lambda value: value[:12] if isinstance(value, bytes) else "",
)
def test_what_opencv_reads_is_read_whatever_its_name(
    body: bytes, tolerance: float, tmp_path: Path
) -> None:
    path = tmp_path / "frame.jpg"
    path.write_bytes(body)
    found = read_whole_image(path)
    assert found.dtype == np.uint8
    assert found.shape == (210, 280, 3)
    assert np.abs(found[:, :, ::-1].astype(int) - SMOOTH).mean() <= tolerance
    assert read_whole_image(path).shape == (210, 280, 3)
    path.write_bytes(body[: len(body) // 2])
    assert fault(path) is Fault.DAMAGED
    with pytest.raises(ImageError):
        read_header(body) if not body.startswith(PNG[:4]) else read_whole_image(path)


def test_a_cmyk_jpeg_and_a_jpeg_without_huffman_tables_are_read(tmp_path: Path) -> None:
    """The last ones are single frames of Motion JPEG."""
    path, rgb = tmp_path / "a.jpg", SMOOTH[:, :, ::-1]
    ink = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])  # as Adobe stores it: inverted
    path.write_bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(ink), 95, "CMYK", "444"))
    assert np.abs(read_whole_image(path).astype(int) - rgb).mean() < 3
    body = encoded(".jpg")
    while (at := body.find(b"\xff\xc4")) >= 0:
        body = body[:at] + body[at + 2 + int.from_bytes(body[at + 2 : at + 4], "big") :]
    path.write_bytes(body)
    assert np.array_equal(read_whole_image(path), simplejpeg.decode_jpeg(encoded(".jpg")))


@pytest.mark.parametrize("behind", [bytes(100_000), b"\0\0\0\x18ftypmp42" + bytes(5000), JPEG])
def test_bytes_behind_an_image_do_not_matter_locally(behind: bytes, tmp_path: Path) -> None:
    """Bytes after the image: padding, the film of a Motion Photo, the second picture of a stereo
    pair (MPO)."""
    path = tmp_path / "a"
    for body in (JPEG, PNG):
        path.write_bytes(body + behind)
        assert np.array_equal(read_whole_image(path), decode_whole(body, read_header(body)))
    path.write_bytes(JPEG[:-2] + bytes(300) + JPEG[-2:] + bytes(50))  # padded before its end, too
    assert np.array_equal(read_whole_image(path), simplejpeg.decode_jpeg(JPEG))
    path.write_bytes(JPEG[: len(JPEG) // 2] + behind[:1000])
    assert fault(path) is Fault.DAMAGED


def test_a_photo_larger_than_the_service_takes_is_scaled(tmp_path: Path) -> None:
    """Images of 12 million pixels, also with ten scans, and a PNG of many small chunks."""
    large = cv2.resize(SMOOTH, (4000, 3000), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    options: list[list[int]] = [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]]
    bodies = [encoded(".jpg", large, *each) for each in options]
    with pytest.raises(ImageError, match="4000 x 3000 px"):
        read_header(bodies[0])
    for body in (*bodies, PNG[:33] + chunk(b"teXt", b"") * 3000 + PNG[33:]):
        (tmp_path / "a").write_bytes(body)
        whole = NOISE if body.startswith(PNG[:4]) else large
        expected = crop_and_resize(whole[:, :, ::-1], VIEW).astype(int)
        assert np.abs(crop_and_resize(read_whole_image(tmp_path / "a"), VIEW) - expected).mean() < 2


@pytest.mark.parametrize(
    ("body", "size"),
    [
        (b"BM" + bytes(12) + struct.pack("<IiiHH", 40, 60000, -60000, 1, 24), "60000 x 60000"),
        (b"RIFF\x64\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\xff\xff\xff" * 2, "16777216 x"),
        (b"II" + struct.pack("<HIH", 42, 8, 2) + struct.pack("<HHII", 256, 4, 1, 70000)
         + struct.pack("<HHII", 257, 4, 1, 70000), "70000 x 70000"),
        (b"P6 # wide\n99999 99999 255\n", "99999 x 99999"),
        (b"GIF89a" + struct.pack("<HH", 65535, 65535), "65535 x 65535"),
        (PNG[:8] + chunk(b"IHDR", struct.pack(">IIBBBBB", 40000, 30000, 8, 2, 0, 0, 0)),
         "40000 x 30000"),
        (encoded(".jpg", np.zeros((15, 20, 3), np.uint8)), "20 x 15"),
    ],
)  # fmt: skip
def test_a_size_that_does_not_fit_the_memory_is_refused_by_its_header(
    body: bytes, size: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "a").write_bytes(body + bytes(100))
    with pytest.raises(ImageError, match=f"{size}.* 256 million px") as caught:
        read_whole_image(tmp_path / "a")
    assert caught.value.fault is Fault.SIZE


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", r"HEIC \(HEIF\) photo; save it as JPEG or PNG"),
        (b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic", "HEIC"),
        (b"\0\0\0\x18ftypisom\0\0\0\0isommp41", r"a film; give a film .*\.mp4"),
        (b"\x1a\x45\xdf\xa3" + bytes(9), "a film"),
        (b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "raw file"),
        (b"%PDF-1.7", "a PDF"),
        (b"\n<!doctype html><html>", "an HTML page; download the image itself"),
        (b"<?xml version='1.0'?><svg width='3'>", "an SVG drawing"),
        (b"<?xml version='1.0'?><annotation>", "an XML file"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"PK\x03\x04", "unpack it"),
        (bytes(4000), "zeros only"),
        (b"", "nothing at all"),
        (b"hello, this is text", "19 bytes that begin with b'hello, t'"),
        (b"\xff\x0a\xfa\x1f", "JPEG XL"),
        (b"\x93NUMPY", "NumPy"),
        (b"\x28\xb5\x2f\xfd\x04", "Zstandard; .*give the folder of the bag"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag; convert it"),
    ],
)
def test_a_kind_that_is_not_read_is_named(body: bytes, named: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(body)
    with pytest.raises(ImageError, match=rf"a\.jpg: no image file \(JPEG, .*, but .*{named}"):
        read_whole_image(tmp_path / "a.jpg")
    with pytest.raises(ImageError, match=f"^no JPEG or PNG file, but .*{named}"):
        read_header(body)


def test_the_preview_in_a_raw_file_is_not_taken_for_the_photo(tmp_path: Path) -> None:
    path = tmp_path / "a.dng"
    for entry in ((254, 4, 1, 1), (50706, 1, 4, 1)):  # a reduced image; DNGVersion
        body = b"II" + struct.pack("<HIH", 42, 8, 1) + struct.pack("<HHII", *entry)
        path.write_bytes(body + bytes(500))
        assert fault(path) is Fault.UNSUPPORTED

"""Reading image files for `mtlnet predict`: the same checks and pixels as in the service."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import simplejpeg

from mtlnet.inference.image_decoding.decode import decode, inspect, read_image
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

VIEW = CameraParameters()
NOISE = np.random.default_rng(3).integers(0, 256, (210, 280, 3), np.uint8)
JPEG: bytes = simplejpeg.encode_jpeg(NOISE, 90)
PNG = cv2.imencode(".png", NOISE)[1].tobytes()
# An APP1 segment with EXIF orientation 6 (rotated by 90 degrees).
EXIF = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
ROTATED = JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(EXIF) + 2) + EXIF + JPEG[2:]


def fault(path: Path) -> Fault:
    with pytest.raises(ImageError, match=path.name) as caught:
        read_image(path, VIEW)
    return caught.value.fault


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame"
    for body in (JPEG, PNG):
        flipped = bytearray(body)
        flipped[len(body) // 2 : len(body) // 2 + 2] = b"\xff\x13"
        path.write_bytes(flipped)
        assert fault(path) is Fault.DAMAGED
        path.write_bytes(body[:-40])
        assert fault(path) is Fault.DAMAGED


def test_a_huge_image_is_refused_by_its_header(tmp_path: Path) -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", 40000, 30000, 8, 2, 0, 0, 0)
    body = b"\x89PNG\r\n\x1a\n\0\0\0\x0d" + header + struct.pack(">I", zlib.crc32(header))
    (tmp_path / "giant.png").write_bytes(body + bytes(60))
    assert fault(tmp_path / "giant.png") is Fault.SIZE


def test_a_file_gives_the_same_pixels_as_in_the_service(tmp_path: Path) -> None:
    """Also with an EXIF orientation, which is ignored, and for a smaller image, which is scaled."""
    small = simplejpeg.encode_jpeg(np.ascontiguousarray(NOISE[:105, :140]), 90)
    for body in (JPEG, ROTATED, PNG, small):
        path = tmp_path / "frame"
        path.write_bytes(body)
        assert np.array_equal(read_image(path, VIEW), decode(body, inspect(body, VIEW), VIEW))
    (tmp_path / "rotated.jpg").write_bytes(ROTATED)
    assert np.array_equal(read_image(tmp_path / "rotated.jpg", VIEW), simplejpeg.decode_jpeg(JPEG))


def test_a_missing_and_a_too_large_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no image file"):
        read_image(tmp_path / "none.jpg", VIEW)
    with (tmp_path / "huge.jpg").open("wb") as file:
        file.truncate((32 << 20) + 1)
    with pytest.raises(UserError, match=r"huge\.jpg has 33554433 bytes"):
        read_image(tmp_path / "huge.jpg", VIEW)

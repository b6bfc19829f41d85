"""The origin of a lens that is not calibrated: given, EXIF, or a guess."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from mtlnet.calibration.lens import find_lens
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MODEL = CameraParameters()


def photo(path: Path, focal_mm: int | None, width: int = 400, height: int = 300) -> Path:
    """A JPEG photo whose EXIF states this focal length in 35 mm film."""
    jpeg = simplejpeg.encode_jpeg(np.zeros((height, width, 3), np.uint8))
    pointer = struct.pack("<HHII", 0x8769, 4, 1, 26)
    block = b"II*\0" + struct.pack("<IH", 8, 1) + pointer + struct.pack("<I", 0)
    assert len(block) == 26
    entry = struct.pack("<HHIHH", 0xA405, 3, 1, focal_mm or 0, 0)
    exif = b"Exif\0\0" + block + struct.pack("<H", 1) + entry + struct.pack("<I", 0)
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    path.write_bytes(jpeg if focal_mm is None else jpeg[:2] + segment + jpeg[2:])
    return path


def test_a_given_field_of_view() -> None:
    lens = find_lens((640, 360), replace(MODEL, x=0.4, y=0.1), fov_y_deg=40.0)
    assert (lens.camera.width, lens.camera.height, lens.camera.fov_y_deg) == (640, 360, 40.0)
    assert (lens.camera.x, lens.camera.y, lens.std) == (0.4, 0.1, 0.0)
    with pytest.raises(UserError, match="--fov-y-deg: vertical field of view 170"):
        find_lens((640, 360), MODEL, fov_y_deg=170.0)


def test_a_photo_gives_the_focal_length(tmp_path: Path) -> None:
    lens = find_lens((1920, 1080), MODEL, photo=photo(tmp_path / "a.jpg", 26))
    # 26 mm on 36 x 24 mm; the photo is 4 : 3, and the film is as wide as it.
    focal_px = 26 / 43.27 * 500 / 400 * 1920
    assert lens.camera.focal_px == pytest.approx(focal_px, rel=1e-3)
    assert lens.std == 0.05
    upright = find_lens((1080, 1920), MODEL, photo=tmp_path / "a.jpg")
    assert upright.camera.focal_px == pytest.approx(focal_px, rel=1e-3)
    for focal_mm in (None, 0):
        with pytest.raises(UserError, match=r"b\.jpg states no focal length"):
            find_lens((640, 360), MODEL, photo=photo(tmp_path / "b.jpg", focal_mm))


def test_a_guess_is_stated() -> None:
    lens = find_lens((640, 360), MODEL)
    assert lens.camera.focal_px == pytest.approx(320 / math.tan(math.radians(32.5)), rel=1e-6)
    assert lens.std == 0.2
    assert "guessed" in lens.about


def test_a_camera_file_of_other_pictures() -> None:
    given = CameraParameters(1280, 720, matrix=(900.0, 905.0, 640.0, 350.0))
    lens = find_lens((640, 360), MODEL, given)
    assert lens.camera.intrinsics()[0, 0] == pytest.approx(450.0)
    with pytest.raises(UserError, match="640 x 480 px, the camera file is for 1280 x 720"):
        find_lens((640, 480), MODEL, given)

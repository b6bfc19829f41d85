"""A user's own images: valid `labels.csv` files, and error messages that name the faulty line."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.data.custom_images import (
    MARKING_LIMITS_M,
    CustomImages,
    open_custom_images,
    read_labels,
)
from mtlnet.inference.rectification import Rectification
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

HEAD = "file,ml,mr,l,m,r,angle,heading"
GOOD = "a.png,-1.5,2.5,,,,0.02,straight"


def write(folder: Path, *rows: str, head: str = HEAD) -> Path:
    (folder / "labels.csv").write_text("\n".join([head, *rows, ""]))
    return folder / "labels.csv"


def picture(path: Path, width: int, height: int, value: int = 90) -> None:
    image = np.full((height, width, 3), value, np.uint8)
    image[:, width // 2 :] = (0, 0, 255)  # BGR: the right half is red
    cv2.imwrite(str(path), image)


def test_labels_are_read_with_absent_markings_as_nan(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD, "sub/b.jpg,,,-4.1,-0.1,,-0.3,left", "c.png,,,,,,0,right")
    files, labels = read_labels(path)
    assert files == [(2, "a.png"), (3, "sub/b.jpg"), (4, "c.png")]
    nan = np.nan
    expected = [[-1.5, 2.5, nan, nan, nan], [nan, nan, -4.1, -0.1, nan], [nan] * 5]
    np.testing.assert_allclose(labels.distances, expected, rtol=1e-6)
    np.testing.assert_allclose(labels.angle, [0.02, -0.3, 0], rtol=1e-6)
    assert labels.heading.tolist() == [tf.Heading.STRAIGHT, tf.Heading.LEFT, tf.Heading.RIGHT]
    # The labels survive the network's coding.
    distances, _ = tf.decode(tf.encode(labels.distances, labels.angle))
    np.testing.assert_allclose(distances, labels.distances, atol=1e-5)


def test_label_limits_are_those_of_the_coding() -> None:
    for i, marking in enumerate(tf.MARKINGS):
        for limit, coded in zip(MARKING_LIMITS_M[marking], (0.1, 0.9), strict=True):
            values = np.full((1, 5), np.nan)
            values[0, i] = limit
            found = float(tf.encode(values, np.zeros(1))[0, i])
            # Beyond its limit m would be decoded as absent, before the end of its range.
            assert found == pytest.approx(0.1 + 0.8 * 4.75 / 5.5 if limit == 2.75 else coded)


@pytest.mark.parametrize(
    ("row", "seen"),
    [
        ("b.png,1.5,2.5,,,,0,straight", r"line 3: ml is 1.5 m; it must be from -5.5 to -0.5"),
        ("b.png,-1.5,,,,,0,straight", "line 3: ml and mr are the two sides"),
        ("b.png,,,-3,,,0,straight", "line 3: l and r stand beside m"),
        ("b.png,-1,nan,,,,0,straight", "line 3: mr is nan m"),
        ("b.png,-1,x,,,,0,straight", "line 3: mr is 'x', not a number"),
        ("b.png,-1,1,,,,2.5,straight", r"line 3: angle is 2.5; it must be within 0.5 rad"),
        ("b.png,-1,1,,,,,straight", "line 3: angle is '', not a number"),
        ("b.png,-1,1,,,,0,ahead", "line 3: heading is 'ahead'; give left, straight, right"),
        ("../b.png,-1,1,,,,0,left", "line 3: the file '../b.png' is no path within"),
        ("b.png,-1,1", "line 3: it has not 8 values"),
        ("b.png,-1,1,,,,0,left,9", "line 3: it has not 8 values"),
        ("a.png,-1,1,,,,0,left", "line 3: a.png stands in line 2 already"),
    ],
)
def test_a_faulty_row_is_refused_with_its_line_number(tmp_path: Path, row: str, seen: str) -> None:
    with pytest.raises(UserError, match=seen):
        read_labels(write(tmp_path, GOOD, row))


def test_faulty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"first line must name file, ml, mr, l, m, r"):
        read_labels(write(tmp_path, GOOD, head="file,ml,mr"))
    with pytest.raises(UserError, match="names no images"):
        read_labels(write(tmp_path))
    write(tmp_path, GOOD)
    with pytest.raises(UserError, match=r"line 2: there is no image file .*a\.png"):
        open_custom_images(tmp_path, CameraParameters())
    picture(tmp_path / "a.png", 280, 200)
    with pytest.raises(UserError, match=r"line 2: .*280 x 200 px, .* 280 x 210: give"):
        open_custom_images(tmp_path, CameraParameters())


def test_images_of_any_size_with_the_cameras_aspect_ratio(tmp_path: Path) -> None:
    write(tmp_path, GOOD, "b.png,,,,,,0,left")
    picture(tmp_path / "a.png", 280, 210)
    picture(tmp_path / "b.png", 562, 420, 30)  # 0.4 percent off
    found = open_custom_images(tmp_path, CameraParameters())
    assert isinstance(found, CustomImages)
    assert found.images.shape == (2, 210, 280, 3)
    batch = found.read_batch(np.array([1, 0]))
    assert batch[:, 100, 20].tolist() == [[30, 30, 30], [90, 90, 90]]
    assert batch[:, 100, 260].tolist() == [[255, 0, 0]] * 2  # RGB
    before = found.content_hash
    picture(tmp_path / "a.png", 280, 210, 91)
    assert open_custom_images(tmp_path, CameraParameters()).content_hash != before


def test_a_table_of_a_windows_program_and_names_that_are_not_utf8_are_read(tmp_path: Path) -> None:
    """A byte order mark, CRLF, quotes; and a name in the bytes of the file system."""
    picture(tmp_path / "a.png", 280, 210)
    (tmp_path / "a.png").rename(tmp_path / os.fsdecode(b"caf\xe9, 1.png"))
    row = GOOD.encode().replace(b"a.png", b'"caf\xe9, 1.png"')
    (tmp_path / "labels.csv").write_bytes(b"\xef\xbb\xbf" + HEAD.encode() + b"\r\n" + row + b"\r\n")
    assert len(open_custom_images(tmp_path, CameraParameters())) == 1
    with pytest.raises(UserError, match=r"columns file;ml;mr;.* with commas between them"):
        read_labels(write(tmp_path, GOOD, head=HEAD.replace(",", ";")))


@pytest.mark.parametrize("rectified", [False, True])
def test_labelled_images_are_turned_upright(rectified: bool, tmp_path: Path) -> None:
    """A PNG that is stored upside down, and a lossless WebP stored on its side."""
    image = np.arange(280 * 210 * 3, dtype=np.uint32).reshape(210, 280, 3).astype(np.uint8)
    stored = {3: (".png", image[::-1, ::-1]), 6: (".webp", np.rot90(image))}
    for orientation, (suffix, pixels) in stored.items():
        exif = b"II*\0\x08\0\0\0\1\0\x12\1\3\0\1\0\0\0" + bytes((orientation, 0, 0, 0)) + bytes(4)
        done, body = cv2.imencodeWithMetadata(
            suffix,
            np.ascontiguousarray(pixels[:, :, ::-1]),
            [cv2.IMAGE_METADATA_EXIF],
            [np.frombuffer(exif, np.uint8)],
            [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else [],
        )
        assert done
        (tmp_path / f"{orientation}{suffix}").write_bytes(body.tobytes())
    write(tmp_path, GOOD.replace("a.png", "3.png"), GOOD.replace("a.png", "6.webp"))
    camera = CameraParameters()
    lens = Rectification(camera, camera) if rectified else None
    found = open_custom_images(tmp_path, camera, lens).images
    assert np.array_equal(found, np.stack([image, image]))

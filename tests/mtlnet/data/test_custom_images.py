"""A user's own images: valid `labels.csv` files, and error messages that name the faulty line."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.data.custom_images import CustomImages, open_custom_images
from mtlnet.data.labels_file import (
    lane_cells,
    read_cells,
    read_labels,
    write_cells,
)
from mtlnet.data.picture_copies import COPIES
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
    pictures, labels = read_labels(path)
    assert [(p.line, p.file) for p in pictures] == [(2, "a.png"), (3, "sub/b.jpg"), (4, "c.png")]
    nan = np.nan
    expected = [[-1.5, 2.5, nan, nan, nan], [nan, nan, -4.1, -0.1, nan], [nan] * 5]
    np.testing.assert_allclose(labels.distances, expected, rtol=1e-6)
    np.testing.assert_allclose(labels.angle, [0.02, -0.3, 0], rtol=1e-6)
    assert labels.heading.tolist() == [tf.RoadClass.STRAIGHT, tf.RoadClass.LEFT, tf.RoadClass.RIGHT]
    # The labels survive the network's coding.
    distances, _ = tf.decode(tf.encode(labels.distances, labels.angle))
    np.testing.assert_allclose(distances, labels.distances, atol=1e-5)


@pytest.mark.parametrize(
    ("row", "seen"),
    [
        ("b.png,1.5,2.5,,,,0,straight", r"line 3: ml is 1.5 m; it must be from -5.5 to -0.5"),
        ("b.png,-1.5,,,,,0,straight", "line 3: ml and mr are the two sides"),
        ("b.png,,,-3,,,0,straight", "line 3: l and r are the markings next to m"),
        ("b.png,-1,nan,,,,0,straight", "line 3: mr is nan m"),
        ("b.png,-1,x,,,,0,straight", "line 3: mr is 'x', not a number"),
        ("b.png,-1,1,,,,2.5,straight", r"line 3: angle is 2.5; it must be within 0.5 rad"),
        ("b.png,-1,1,,,,,straight", "line 3: angle is '', not a number"),
        ("b.png,-1,1,,,,0,ahead", "line 3: heading is 'ahead'; give left, straight, right"),
        ("../b.png,-1,1,,,,0,left", "line 3: the file '../b.png' is no path within"),
        ("b.png,-1,1", "line 3: it has not 8 values"),
        ("b.png,-1,1,,,,0,left,9", "line 3: it has not 8 values"),
        ("a.png,-1,1,,,,0,left", "line 3: a.png stands in line 2 already"),
        ("b.png,?,1,,,,0,left", r"line 3: ml is `\?`, which only l, m, r, heading may be"),
        ("b.png,-1,?,,,,0,left", r"line 3: mr is `\?`, which only"),
        ("b.png,-1,1,,,,?,left", r"line 3: angle is `\?`, which only"),
        ("?,-1,1,,,,0,left", r"line 3: file is `\?`, which only"),
        ("b.png,-1,1,,?,,0,left", r"line 3: l and r are the markings next to m: where m is `\?`"),
        ("b.png,-1,1,?,,,0,left", "line 3: l and r are the markings next to m: without m"),
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
    """A byte order mark, CRLF, quotes, and a name in the bytes of the file system."""
    picture(tmp_path / "a.png", 280, 210)
    (tmp_path / "a.png").rename(tmp_path / os.fsdecode(b"caf\xe9, 1.png"))
    row = GOOD.encode().replace(b"a.png", b'"caf\xe9, 1.png"')
    (tmp_path / "labels.csv").write_bytes(b"\xef\xbb\xbf" + HEAD.encode() + b"\r\n" + row + b"\r\n")
    assert len(open_custom_images(tmp_path, CameraParameters())) == 1
    with pytest.raises(UserError, match=r"columns file;ml;mr;.* with commas between them"):
        read_labels(write(tmp_path, GOOD, head=HEAD.replace(",", ";")))


def test_unknown_labels_and_optional_columns(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "a.png,-1.5,2.5,?,?,?,0.02,?,highway 1,night,,-0.5,0.001,0.06,0.006",
        "b.png,-0.9,2.7,?,-0.9,2.7,0,left,,,cameras/b.yaml,,,,",
        head=HEAD + ",drive,light,camera,pitch_deg,curvature_1pm,std_m,std_rad",
    )
    pictures, labels = read_labels(path)
    inf = np.inf
    np.testing.assert_allclose(
        labels.distances, [[-1.5, 2.5, inf, inf, inf], [-0.9, 2.7, inf, -0.9, 2.7]], rtol=1e-6
    )
    assert labels.heading.tolist() == [-1, 0]
    first, second = pictures
    assert (first.drive, first.light, first.camera) == ("highway 1", "night", "")
    assert (first.pitch_deg, first.curvature) == (-0.5, 0.001)
    assert (first.std_m, first.std_rad) == (0.06, 0.006)
    assert (second.camera, second.pitch_deg, second.std_m) == ("cameras/b.yaml", None, 0.0)
    # Coded: NaN where unknown, also of the mirrored scene; the inactive end where absent.
    coded = tf.encode(labels.distances, labels.angle)
    assert np.isnan(coded).tolist() == [
        [False, False, True, True, True, False],
        [False, False, True, False, False, False],
    ]
    assert np.isnan(tf.mirror_coded(coded))[1].tolist() == [False, False, False, False, True, False]
    assert tf.mirror_heading(labels.heading).tolist() == [-1, 2]


@pytest.mark.parametrize(
    ("cell", "seen"),
    [
        ("?,,,", r"line 2: pitch_deg is `\?`"),
        ("40,,,", "line 2: pitch_deg is 40; it must be within 30 degrees"),
        (",-1,,", "line 2: curvature_1pm is -1; it must be within 0.2"),
        (",,-1,", "line 2: std_m is -1; it must be 0 or more"),
        (",,,nan", "line 2: std_rad is nan; it must be 0 or more"),
    ],
)
def test_faulty_optional_cells_are_refused(tmp_path: Path, cell: str, seen: str) -> None:
    head = HEAD + ",pitch_deg,curvature_1pm,std_m,std_rad"
    with pytest.raises(UserError, match=seen):
        read_labels(write(tmp_path, f"{GOOD},{cell}", head=head))
    with pytest.raises(UserError, match=r"line 2: the camera '/etc/x' is no path within"):
        read_labels(write(tmp_path, f"{GOOD},/etc/x", head=HEAD + ",camera"))
    with pytest.raises(UserError, match="and may name drive, light, camera"):
        read_labels(write(tmp_path, GOOD + ",x", head=HEAD + ",colour"))


def test_rows_are_written_as_they_are_read(tmp_path: Path) -> None:
    rows = [
        {"file": os.fsdecode(b"caf\xe9, 1.png"), "angle": "0.1", "heading": "?", "drive": "a, b"},
        {"file": "b.png", "angle": "0", "heading": "left", "ml": "-1.5", "mr": "2"},
    ]
    write_cells(tmp_path / "labels.csv", rows)
    found = [cells for _, cells in read_cells(tmp_path / "labels.csv")]
    assert [{k: v for k, v in cells.items() if v} for cells in found] == rows
    assert "pitch_deg" not in found[0]
    assert not [path for path in tmp_path.iterdir() if path.name != "labels.csv"]


def test_cells_of_a_lane_follow_the_definitions() -> None:
    assert lane_cells(-1.7, 1.9) == {"ml": "-1.700", "mr": "1.900", "l": "", "m": "", "r": ""}
    near = lane_cells(-0.8, 2.8)
    assert near == {"ml": "-0.800", "mr": "2.800", "l": "?", "m": "-0.800", "r": "2.800"}
    on_it = lane_cells(-3.4, 0.2)
    assert on_it == {"ml": "", "mr": "", "l": "-3.400", "m": "0.200", "r": "?"}
    measured = tf.measure(-1.0, 0.0, 0.0, 0.0, 1, 3.6)  # one lane: the car right of its middle
    cells = lane_cells(measured.ml or 0, measured.mr or 0)
    assert float(cells["m"]) == pytest.approx(measured.m)
    assert float(cells["l"]) == pytest.approx(measured.l)


def test_pictures_of_their_own_cameras(tmp_path: Path) -> None:
    """A camera in a row has precedence over the folder's; pitch_deg changes either."""
    for name in "abc":
        picture(tmp_path / f"{name}.png", 640, 360)
    (tmp_path / "camera.yaml").write_text("{width: 640, height: 360, x: 0.0, z: 0.95}\n")
    (tmp_path / "high.yaml").write_text("{width: 640, height: 360, x: 0.5, z: 2.15}\n")
    write(
        tmp_path,
        "a.png,-1.5,2.5,,,,0.1,?,,",
        "b.png,-2,2.6,?,?,?,0.1,?,high.yaml,1.5",
        "c.png,-2,2.6,?,?,?,0.1,?,high.yaml,",
        head=HEAD + ",camera,pitch_deg",
    )
    found = open_custom_images(tmp_path, CameraParameters())
    sources = [lens.source for lens in found.lenses if lens is not None]
    assert [s.height_above_road_m for s in sources] == pytest.approx([1.2, 2.4, 2.4])
    assert [s.pitch_deg for s in sources] == [0.0, 1.5, 0.0]
    trained = found.for_training.labels.distances
    ahead = 0.75 * np.sin(0.1)
    np.testing.assert_allclose(trained[0, :2], [-1.5 + ahead, 2.5 + ahead], rtol=1e-5)
    beside = (np.array([-2, 2.6]) - 0.5 * np.sin(0.1)) / 2 + ahead
    np.testing.assert_allclose(trained[1, :2], beside, rtol=1e-5)
    assert np.isinf(trained[1, 2:]).all()
    # The network's answers for them are converted back to the labels.
    outputs = np.concatenate(
        [np.nan_to_num(tf.encode(trained, found.labels.angle)), np.zeros((3, 3))], axis=1
    ).astype(np.float32)
    values = tf.decode_values(found.outputs(outputs)[:, :6])
    np.testing.assert_allclose(values[:, :2], found.labels.distances[:, :2], atol=1e-5)
    before = found.content_hash
    (tmp_path / "high.yaml").write_text("{width: 640, height: 360, x: 0.5, z: 2.16}\n")
    assert open_custom_images(tmp_path, CameraParameters()).content_hash != before


def test_cameras_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    picture(tmp_path / "a.png", 640, 360)
    head = HEAD + ",camera"
    write(tmp_path, GOOD + ",none.yaml", head=head)
    with pytest.raises(UserError, match=r"line 2: .*none\.yaml cannot be read as a camera"):
        open_custom_images(tmp_path, CameraParameters())
    (tmp_path / "narrow.yaml").write_text("{width: 640, height: 360, fov_y_deg: 4}\n")
    write(tmp_path, GOOD + ",narrow.yaml", head=head)
    with pytest.raises(UserError, match=r"line 2: .*the image shows"):
        open_custom_images(tmp_path, CameraParameters())
    (tmp_path / "low.yaml").write_text("{width: 640, height: 360, z: 0.15}\n")
    write(tmp_path, GOOD + ",low.yaml", head=head)
    found = open_custom_images(tmp_path, CameraParameters())
    with pytest.raises(UserError, match=r"line 2: from the height of .* mr is 7\.\d+ m, which the"):
        _ = found.for_training


def test_refused_pictures_are_listed_where_they_are_counted(tmp_path: Path) -> None:
    picture(tmp_path / "a.png", 640, 360)
    picture(tmp_path / "b.png", 640, 360)
    (tmp_path / "narrow.yaml").write_text("{width: 640, height: 360, fov_y_deg: 4}\n")
    (tmp_path / "wide.yaml").write_text("{width: 640, height: 360}\n")
    rows = (GOOD + ",narrow.yaml", GOOD.replace("a.png", "b.png") + ",wide.yaml")
    write(tmp_path, *rows, head=HEAD + ",camera")
    found = open_custom_images(tmp_path, CameraParameters(), COPIES, skip_refused=True)
    assert found.copies == COPIES
    assert [(p.file, copy) for p, copy, _ in found.refused] == [("a.png", c) for c in COPIES]
    assert len(found.hashes) == len(found.pictures) == len(found.lenses) == len(found) == 4


def test_every_nth_picture_is_read_with_all_its_copies(tmp_path: Path) -> None:
    """Pictures 0, 2, 4 and 6 are of a camera that shows too little of the model's view."""
    for name in "abcdefgh":
        picture(tmp_path / f"{name}.png", 640, 360)
    (tmp_path / "narrow.yaml").write_text("{width: 640, height: 360, fov_y_deg: 4}\n")
    (tmp_path / "wide.yaml").write_text("{width: 640, height: 360}\n")
    cameras = dict(zip("abcdefgh", ("narrow", "wide") * 4, strict=True))
    rows = [f"{GOOD.replace('a.png', f'{k}.png')},{v}.yaml" for k, v in cameras.items()]
    write(tmp_path, *rows, head=HEAD + ",camera")
    (tmp_path / "b.png").write_bytes(b"damaged, and not read")
    found = open_custom_images(tmp_path, CameraParameters(), COPIES, every=3, skip_refused=True)
    assert [(p.file, copy) for p, copy, _ in found.refused] == [
        (file, copy) for file in ("a.png", "g.png") for copy in COPIES
    ]
    assert [p.file for p in found.pictures] == ["d.png"] * len(COPIES)
    assert found.copies == COPIES
    assert len(found.labels) == len(found) == len(COPIES)


@pytest.mark.parametrize("rectified", [False, True])
def test_labelled_images_are_turned_upright(rectified: bool, tmp_path: Path) -> None:
    """A PNG stored upside down, and a lossless WebP stored on its side."""
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
    if rectified:
        (tmp_path / "camera.yaml").write_text("x: 0.75\n")
    found = open_custom_images(tmp_path, camera).images
    assert np.array_equal(found, np.stack([image, image]))

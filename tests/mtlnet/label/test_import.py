"""Tables of other terms become a folder that `evaluate` reads; faulty ones are one clear line."""

import errno
import os
import shutil
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest

from mtlnet.data.custom_images import open_custom_images
from mtlnet.data.labels_file import read_labels
from mtlnet.label.folder import LabelFolder
from mtlnet.label.import_table import import_labels, parse_label_std
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

HEAD = "file,x_left_m,x_right_m,heading_rad,fov_y_deg,camera_height_m"
ROW = "a.png,1.7,-1.9,0,40,1.22"
MORE = ",light,drive,curvature_1pm,focal_px,horizon_y_px,quality"


def table(folder: Path, *rows: str, head: str = HEAD + MORE) -> Path:
    folder.mkdir(exist_ok=True)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), np.full((360, 640, 3), 90, np.uint8))
    (folder / "table.csv").write_text("\n".join([head, *rows]) + "\n")
    return folder / "table.csv"


def test_a_table_becomes_labels_and_cameras(tmp_path: Path) -> None:
    path = table(
        tmp_path / "theirs",
        'a.png,1.7,-1.9,0.03,40,1.22,"day, shade",drive 1,0.001,500,189.5,A',
        "b.png,0.9,-2.6,-0.01,40,1.5,night,drive 2,-0.01,500,169.5,B",
    )
    stds = parse_label_std(["0.06,0.006", "b*=0.16,0.012"])
    found = import_labels(path, tmp_path / "mine", stds)
    assert (found["pictures"], found["cameras"]) == (2, 2)
    pictures, labels = read_labels(tmp_path / "mine" / "labels.csv")
    np.testing.assert_allclose(labels.distances[0, :2], [-1.7, 1.9], rtol=1e-6)
    # Within 1.2 m of the left marking, which is the one it drives on; beyond it nothing is known.
    np.testing.assert_allclose(labels.distances[1], [-0.9, 2.6, np.inf, -0.9, 2.6], rtol=1e-6)
    assert labels.heading.tolist() == [-1, 2]  # gentle: not known 20 m ahead; 100 m to the right
    assert [p.std_m for p in pictures] == [0.06, 0.16]
    assert [(p.light, p.drive) for p in pictures] == [
        ("day, shade", "drive 1"),
        ("night", "drive 2"),
    ]
    # Horizon 10 px below the middle: the camera looks up by atan(10 / 500).
    assert pictures[0].pitch_deg == pytest.approx(-np.degrees(np.arctan(10 / 500)), abs=1e-4)
    assert pictures[1].pitch_deg == pytest.approx(np.degrees(np.arctan(10 / 500)), abs=1e-4)
    opened = open_custom_images(tmp_path / "mine", CameraParameters())
    heights = [lens.source.height_above_road_m for lens in opened.lenses if lens is not None]
    assert heights == pytest.approx([1.22, 1.5])
    with pytest.raises(UserError, match=r"labels\.csv exists; give a new folder"):
        import_labels(path, tmp_path / "mine")


def test_a_camera_file_has_the_median_pitch_of_its_pictures(tmp_path: Path) -> None:
    """The label page keeps this pitch, and pictures without a pitch have it."""
    (tmp_path / "theirs").mkdir()
    for name in ("c.png", "d.png", "e.png"):
        cv2.imwrite(str(tmp_path / "theirs" / name), np.full((360, 640, 3), 90, np.uint8))
    path = table(
        tmp_path / "theirs",
        "a.png,1.7,-1.9,0,40,1.22,,,0,500,189.5,",
        "b.png,1.7,-1.9,0,40,1.22,,,0,500,169.5,",
        "c.png,1.7,-1.9,0,40,1.22,,,0,500,159.5,",
        "d.png,1.7,-1.9,0,40,1.22,,,0,,,",
        "e.png,1.7,-1.9,0,40,1.5,,,0,,,",
    )
    assert import_labels(path, tmp_path / "mine")["cameras"] == 2
    folder = LabelFolder(tmp_path / "mine", None, CameraParameters())
    pitches = [folder.camera(number, 640, 360).pitch_deg for number in range(5)]
    median = np.degrees(np.arctan(10 / 500))
    assert pitches == pytest.approx([median] * 4 + [0.0], abs=1e-4)


def test_an_imported_folder_opens_after_a_label_was_removed(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", ROW, "b.png,1.7,-1.9,0,40,1.22", head=HEAD)
    mine = tmp_path / "mine"
    import_labels(path, mine)
    LabelFolder(mine, None, CameraParameters()).remove(0)
    folder = LabelFolder(mine, None, CameraParameters())
    assert folder.camera(1, 640, 360).fov_y_deg == pytest.approx(40)
    with pytest.raises(UserError, match=r"no camera is known for a\.png: .*--camera FILE"):
        folder.camera(0, 640, 360)
    again = LabelFolder(mine, mine / "cameras" / "640x360-40deg.yaml", CameraParameters())
    assert again.camera(0, 640, 360) == again.camera(1, 640, 360)


@pytest.mark.parametrize(
    ("row", "seen"),
    [
        ("a.png,x,-1.9,0,40,1.22", "line 2: x_left_m is 'x', not a number"),
        ("../a.png,1.7,-1.9,0,40,1.22", r"line 2: the file '\.\./a\.png' is not a path"),
        (" a.png,1.7,-1.9,0,40,1.22", "line 2: the file name ' a.png' cannot be written"),
        ("c.png,1.7,-1.9,0,40,1.22", r"line 2: there is no image file .*c\.png"),
        ("a.png,1.7,-7,0,40,1.22", "line 2: mr is 7 m; it must be from 0.5 to 5.5"),
        ("a.png,1.7,-1.9,2,40,1.22", "line 2: angle is 2; it must be within 0.5 rad"),
        ("a.png,1.7,-1.9,0,400,1.22", r"line 2: vertical field of view 400\.0 deg"),
        ("a.png,1.7,-1.9,0,40,0", "line 2: camera_height_m is 0; it must be above 0"),
        (f"{ROW}\nb.png,1.7,-1.9,0,40,-1.2", r"line 3: camera_height_m is -1\.2; it must be"),
        ("a.png,1.7,-1.9,0,40", "line 2: it does not have 6 values"),
        ("a.png,1.7,-1.9,0,40,1.22,9", "line 2: it does not have 6 values"),
        ('a.png,"1.7"x,-1.9,0,40,1.22', "after line 1: ',' expected after"),
        (f"{ROW}\nb.png,1.7,-1.9,0,40,1.22\n{ROW}", r"line 4: a\.png stands in line 2 already"),
        (f"{ROW}\n./{ROW}", r"line 3: a\.png stands in line 2 already"),
        ("b.png,1.7,-1.9,0,40,1.22\n../x.png,1.7,-1.9,0,40,1.22", "line 3: the file"),
    ],
)
def test_a_faulty_row_is_refused(tmp_path: Path, row: str, seen: str) -> None:
    path = table(tmp_path / "theirs", row, head=HEAD)
    with pytest.raises(UserError, match=seen):
        import_labels(path, tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_a_pattern_of_standard_deviations_matches_files_in_folders(tmp_path: Path) -> None:
    names = ("day_1.png", "night_1.png")
    rows = [f"{folder}/{name},1.7,-1.9,0,40,1.22" for folder in ("c", "d") for name in names]
    path = table(tmp_path / "theirs", *rows, head=HEAD)
    for folder in ("c", "d"):
        (path.parent / folder).mkdir()
        for name in names:
            shutil.copy(path.parent / "a.png", path.parent / folder / name)
    stds = parse_label_std(["0.06,0.006", "night_*=0.16,0.012", "d/night*=0.2,0.02"])
    import_labels(path, tmp_path / "mine", stds)
    pictures, _ = read_labels(tmp_path / "mine" / "labels.csv")
    assert [p.std_m for p in pictures] == [0.06, 0.16, 0.06, 0.2]
    wrong = parse_label_std(["0.06,0.006", "nigt_*=0.16,0.012"])
    with pytest.raises(
        UserError, match=r"--label-std 'nigt_\*=0\.16,0\.012': no file of .* matches"
    ):
        import_labels(path, tmp_path / "other", wrong)
    assert not (tmp_path / "other").exists()


def test_a_table_in_latin_1_names_files_by_their_bytes(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", f"{ROW},caf\xe9", head=f"{HEAD},drive")
    name = os.fsdecode(b"caf\xe9.png")
    (path.parent / "a.png").rename(path.parent / name)
    path.write_bytes(path.read_text().replace("a.png", "caf\xe9.png").encode("latin-1"))
    import_labels(path, tmp_path / "mine")
    ((picture,), _) = read_labels(tmp_path / "mine" / "labels.csv")
    assert (picture.file, picture.drive) == (name, "caf\udce9")
    assert (tmp_path / "mine" / name).is_file()


def test_no_file_of_the_folder_is_replaced(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", ROW, head=HEAD)
    mine = tmp_path / "mine"
    (mine / "cameras").mkdir(parents=True)
    (mine / "a.png").write_bytes(b"mine")
    with pytest.raises(UserError, match=r"line 2: .*mine/a\.png exists and is another file; give"):
        import_labels(path, mine)
    assert (mine / "a.png").read_bytes() == b"mine"
    (mine / "a.png").write_bytes((path.parent / "a.png").read_bytes())  # an equal file
    (mine / "cameras" / "640x360-40deg.yaml").write_text("mine")
    import_labels(path, mine)
    assert (mine / "cameras" / "640x360-40deg.yaml").read_text() == "mine"
    ((picture,), _) = read_labels(mine / "labels.csv")
    assert picture.camera == "cameras/640x360-40deg-2.yaml"


def test_the_folder_can_be_the_tables_own(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", ROW, head=HEAD)
    before = (path.parent / "a.png").read_bytes()
    assert import_labels(path, path.parent)["pictures"] == 1
    assert (path.parent / "a.png").read_bytes() == before
    assert len(open_custom_images(path.parent, CameraParameters())) == 1


def test_faulty_tables_and_options_are_refused(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", "a.png,1", head="file,x_left_m")
    with pytest.raises(UserError, match="has no column x_right_m, heading_rad, fov_y_deg"):
        import_labels(path, tmp_path / "mine")
    with pytest.raises(UserError, match="names no pictures"):
        import_labels(table(tmp_path / "theirs", head=HEAD), tmp_path / "mine")
    with pytest.raises(UserError, match=r"--label-std is '0.06'; give METRES,RADIANS"):
        parse_label_std(["0.06"])


def test_an_interrupted_copy_leaves_no_file(tmp_path: Path) -> None:
    path = table(tmp_path / "theirs", ROW, head=HEAD)

    def interrupted(partial: Path, data: bytes) -> None:
        with partial.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, "No space left")

    with (
        mock.patch("pathlib.Path.write_bytes", interrupted),
        pytest.raises(OSError, match=r"No space left.*a\.png"),
    ):
        import_labels(path, tmp_path / "mine")
    assert not list((tmp_path / "mine").iterdir())
    assert import_labels(path, tmp_path / "mine")["pictures"] == 1
    copied = tmp_path / "mine" / "a.png"
    assert copied.read_bytes() == (path.parent / "a.png").read_bytes()

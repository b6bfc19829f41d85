"""The label page's interface: drag, save, undo, and refused requests."""

import os
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from mtlnet.data.custom_images import open_custom_images
from mtlnet.data.labels_file import read_cells, read_labels
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.label.folder import LabelFolder
from mtlnet.label.geometry import marking_pixels
from tests.mtlnet.label.conftest import TRUE, Site, serve
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

LABEL = {"ml": -1.5, "mr": 2.1, "angle": 0.03, "curvature": 0.0, "pitch_deg": 0.5}
VIEW = CameraParameters(width=640, height=360, fov_y_deg=40, x=0.0, z=0.97)


def test_markings_are_dragged_saved_and_read_by_evaluate(site: Site) -> None:
    status, listing, headers = site.ask("GET", "/api/pictures")
    assert (status, headers["x-content-type-options"]) == (200, "nosniff")
    names = [one["file"] for one in listing["pictures"]]
    assert names == ["1.png", "10.png", "sub/2.png"]
    _, shown, _ = site.ask("GET", "/api/pictures/2")
    assert (shown["width"], shown["height"], shown["source"]) == (640, 360, "usual")
    assert shown["markings"]["mr"] - shown["markings"]["ml"] == 3.6
    left, right = (each.tolist() for each in marking_pixels(VIEW, TRUE, [6.0, 25.0]))
    status, found, _ = site.ask("POST", "/api/pictures/2/fit", {"left": left, "right": right})
    assert status == 200
    for name, value in LABEL.items():
        assert found["markings"][name] == pytest.approx(value, abs=1e-3), name
    line = np.array(found["lines"]["left"])
    row = float(np.interp(-left[0][1], -line[:, 1], line[:, 0]))
    assert row == pytest.approx(left[0][0], abs=1.0)
    body = {**found["markings"], "drive": " one ", "light": "dusk"}
    status, saved, _ = site.ask("PUT", "/api/pictures/2/label", body)
    assert (status, saved["row"]["heading"], saved["row"]["drive"]) == (200, "straight", "one")
    pictures, labels = read_labels(site.folder / "labels.csv")
    assert [(p.file, p.light, p.pitch_deg) for p in pictures] == [("sub/2.png", "dusk", 0.5)]
    np.testing.assert_allclose(labels.distances[0, :2], [-1.5, 2.1], atol=1e-3)
    assert np.isnan(labels.distances[0, 2:]).all()
    opened = open_custom_images(site.folder, CameraParameters())
    assert opened.lenses[0] is not None
    assert opened.lenses[0].source.pitch_deg == 0.5
    _, shown, _ = site.ask("GET", "/api/pictures/2")
    assert (shown["source"], shown["markings"]["pitch_deg"]) == ("label", 0.5)
    assert shown["markings"]["ml"] == pytest.approx(-1.5, abs=1e-3)


def test_each_change_is_saved_and_other_rows_stay(site: Site) -> None:
    table = site.folder / "labels.csv"
    head = "file,ml,mr,l,m,r,angle,heading,camera,std_m"
    table.write_text(f"{head}\nelse.png,-1,2.5,?,?,?,0,?,,0.06\n1.png,-1,2.5,?,?,?,0,?,,0.07\n")
    site.ask("PUT", "/api/pictures/0/label", {**LABEL, "curvature": 0.01})
    site.ask("PUT", "/api/pictures/1/label", {**LABEL, "ml": -0.8, "heading": "?"})
    pictures, labels = read_labels(table)
    assert [p.file for p in pictures] == ["1.png", "10.png", "else.png"]
    assert [p.std_m for p in pictures] == [0.07, 0.0, 0.06]
    assert labels.heading.tolist() == [0, -1, -1]  # a bend of 100 m to the left
    np.testing.assert_allclose(labels.distances[1], [-0.8, 2.1, np.inf, -0.8, 2.1], rtol=1e-6)
    assert site.ask("DELETE", "/api/pictures/0/label")[0] == 200
    assert [p.file for p in read_labels(table)[0]] == ["10.png", "else.png"]
    assert not list(site.folder.glob("*.partial"))
    status, told, _ = site.ask("PUT", "/api/pictures/0/label", {**LABEL, "ml": -6.0})
    assert (status, told["detail"][:12]) == (422, "ml is -6 m; ")
    assert [p.file for p in read_labels(table)[0]] == ["10.png", "else.png"]


def test_what_is_no_marking_is_one_line(site: Site) -> None:
    body = {"left": [[10, 300], [20, 5]], "right": [[600, 300], [500, 200]], "pitch_deg": 0.0}
    status, told, _ = site.ask("POST", "/api/pictures/0/fit", body)
    assert (status, "above the horizon" in told["detail"]) == (422, True)
    assert site.ask("POST", "/api/pictures/0/fit", {"left": [[1, 2]], "right": []})[0] == 422
    assert site.ask("PUT", "/api/pictures/0/label", {**LABEL, "file": "/etc/passwd"})[0] == 422
    assert site.ask("PUT", "/api/pictures/0/label", b'{"ml": NaN}')[0] == 422
    assert site.ask("GET", "/api/pictures/3")[0] == 422
    (site.folder / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    status, told, _ = site.ask("GET", "/api/pictures/0")
    assert (status, told["detail"][:6]) == (422, "1.png:")
    assert site.ask("GET", "/api/pictures/-1/image")[0] == 422


@pytest.mark.parametrize(
    "path",
    [
        "/api/pictures/..%2f..%2fsecret.png/image",
        "/../camera.yaml",
        "/camera.yaml",
        "/1.png",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/docs",
        "/openapi.json",
    ],
)
def test_no_file_is_named_by_a_request(site: Site, path: str) -> None:
    assert site.ask("GET", path)[0] in (404, 422)


def test_other_names_and_pages_are_refused(site: Site) -> None:
    assert site.ask("GET", "/api/pictures", Host="evil.example")[0] == 421
    assert site.ask("GET", "/", Host="evil.example")[0] == 421
    assert site.ask("GET", "/api/pictures", Host="localhost:1")[0] == 200
    body = LABEL
    origin = {"Origin": "http://evil.example"}
    assert site.ask("PUT", "/api/pictures/0/label", body, **origin)[0] == 403
    own = {"Origin": f"http://127.0.0.1:{site.port}"}
    assert site.ask("PUT", "/api/pictures/0/label", body, **own)[0] == 200
    # A form of another page sends no JSON.
    assert site.ask("PUT", "/api/pictures/0/label", b"{}", Content_Type="text/plain")[0] == 415
    assert site.ask("PUT", "/api/pictures/0/label", b" " * (65 << 10))[0] == 413


def test_the_token_guards_all_data(guarded: Site) -> None:
    assert guarded.ask("GET", "/")[0] == 200  # asks for the token
    for method, path in (
        ("GET", "/api/pictures"),
        ("GET", "/api/pictures/0/image"),
        ("DELETE", "/api/pictures/0/label"),
    ):
        assert guarded.ask(method, path)[0] == 401
        assert guarded.ask(method, path, Authorization="Bearer another")[0] == 401
    guarded.headers = {"Authorization": "Bearer a-token-of-sixteen"}
    assert guarded.ask("GET", "/api/pictures", Host="phone.example")[0] == 200
    status, image, headers = guarded.ask("GET", "/api/pictures/0/image")
    assert (status, headers["content-type"], image[:2]) == (200, "image/jpeg", b"\xff\xd8")


def test_links_out_of_the_folder_are_left_out(pictures: Path) -> None:
    outside = pictures.parent / "outside"
    outside.mkdir()
    (pictures / "1.png").rename(outside / "1.png")
    (pictures / "1.png").symlink_to(outside / "1.png")
    (pictures / "away").symlink_to(outside)
    folder = LabelFolder(pictures, None, CameraParameters())
    assert folder.files == ["10.png", "sub/2.png"]
    # One that is put there afterwards.
    (pictures / "10.png").unlink()
    (pictures / "10.png").symlink_to(outside / "1.png")
    with pytest.raises(UserError, match="leads out of the folder"):
        folder.picture(0)


def test_a_folder_without_a_camera_is_refused(pictures: Path) -> None:
    (pictures / "camera.yaml").rename(pictures.parent / "dashcam.yaml")
    with pytest.raises(UserError, match=r"has no camera\.yaml, which is needed to compute metres"):
        LabelFolder(pictures, None, CameraParameters())
    folder = LabelFolder(pictures, pictures.parent / "dashcam.yaml", CameraParameters())
    assert folder.camera(0, 1280, 720).height_above_road_m == pytest.approx(1.22)
    with pytest.raises(UserError, match="is 640 x 480 px, its camera gives 640 x 360"):
        folder.camera(0, 640, 480)
    (pictures.parent / "other.yaml").write_text("{width: 640, height: 360, z: 0.3}\n")
    with pytest.raises(UserError, match="describes another camera than"):
        LabelFolder(pictures, pictures.parent / "other.yaml", CameraParameters())
    (pictures / "none").mkdir()
    with pytest.raises(UserError, match="there is no picture in"):
        LabelFolder(pictures / "none", None, CameraParameters())


def test_a_drag_neither_decodes_the_picture_nor_reads_the_labels_again(site: Site) -> None:
    site.ask("PUT", "/api/pictures/0/label", LABEL)
    left, right = (each.tolist() for each in marking_pixels(VIEW, TRUE, [6.0, 25.0]))
    with (
        mock.patch("mtlnet.label.folder.read_whole_image", side_effect=read_whole_image) as decode,
        mock.patch("mtlnet.label.folder.read_cells", side_effect=read_cells) as read,
    ):
        site.ask("GET", "/api/pictures/1")
        site.ask("GET", "/api/pictures/1/image")
        for _ in range(3):
            site.ask("POST", "/api/pictures/1/fit", {"left": left, "right": right})
        assert (decode.call_count, read.call_count) == (1, 1)
        site.ask("GET", "/api/pictures/0")
        assert (decode.call_count, read.call_count) == (2, 1)
        table = site.folder / "labels.csv"
        before = table.stat()
        table.write_text(table.read_text().replace("-1.500", "-1.400"))  # same size, same time
        os.utime(table, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
        _, shown, _ = site.ask("GET", "/api/pictures/0")
        assert shown["markings"]["ml"] == pytest.approx(-1.4)
        (site.folder / "1.png").unlink()
        status, told, _ = site.ask("GET", "/api/pictures/0")
        assert (status, "1.png cannot be read" in told["detail"]) == (422, True)


@pytest.mark.parametrize(
    "row",
    [
        "1.png,,,-3.300,0.300,3.900,0,?",  # the car drives on the right marking of its lane
        "1.png,,,-3.900,-0.300,3.300,0,?",
        "1.png,-2.600,1.000,-2.600,1.000,4.600,0,?",
        "1.png,,,,0.300,3.900,0,?",  # left of the outermost marking
        "1.png,-1,2.6,-4.6,-1,2.6,0,?",  # typed by hand
        "1.png,-1,2.6,,-1,2.6,0,?",
    ],
)
def test_a_label_that_is_saved_as_it_was_keeps_all_its_distances(site: Site, row: str) -> None:
    table = site.folder / "labels.csv"
    table.write_text(f"file,ml,mr,l,m,r,angle,heading\n{row}\n")
    _, before = read_labels(table)
    _, shown, _ = site.ask("GET", "/api/pictures/0")
    assert shown["source"] == "label"
    assert site.ask("PUT", "/api/pictures/0/label", shown["markings"])[0] == 200
    np.testing.assert_array_equal(read_labels(table)[1].distances, before.distances)
    # In another lane, or another place, the marking beyond it is unknown.
    moved = {**shown["markings"], "ml": shown["markings"]["ml"] - 0.01}
    site.ask("PUT", "/api/pictures/0/label", moved)
    assert np.isinf(read_labels(table)[1].distances).sum() == 1


@pytest.mark.parametrize(
    ("row", "fault"),
    [("1.png,-1,2.6,,,,,?", "angle is '', not"), ("1.png,x,2.6,,,,0,?", "ml is 'x', not a number")],
)
def test_a_faulty_row_is_refused_at_the_start_and_later(site: Site, row: str, fault: str) -> None:
    table = site.folder / "labels.csv"
    table.write_text(f"file,ml,mr,l,m,r,angle,heading\n10.png,-1,2.6,,,,0,?\n{row}\n")
    for method, path, body in (
        ("GET", "/api/pictures/0", None),
        ("PUT", "/api/pictures/1/label", LABEL),
    ):
        status, told, _ = site.ask(method, path, body)
        assert status == 422
        assert told["detail"].startswith(f"labels.csv, line 3: {fault}")
    with pytest.raises(UserError, match=rf"labels\.csv, line 3: {fault}"):
        LabelFolder(site.folder, None, CameraParameters())
    assert row in table.read_text()


def test_a_removed_label_can_be_restored_with_its_camera_and_columns(site: Site) -> None:
    (site.folder / "camera.yaml").rename(site.folder / "front.yaml")
    table = site.folder / "labels.csv"
    row = "1.png,,,-3.300,0.300,3.900,0,?,front.yaml,night,0.05"
    table.write_text(f"file,ml,mr,l,m,r,angle,heading,camera,light,std_m\n{row}\n")
    before = [cells for _, cells in read_cells(table)]
    _, shown, _ = site.ask("GET", "/api/pictures/0")
    assert site.ask("DELETE", "/api/pictures/0/label")[0] == 200
    assert site.ask("GET", "/api/pictures/0")[1]["source"] != "label"
    assert site.ask("PUT", "/api/pictures/0/label", shown["markings"])[0] == 200
    ((_, after),) = read_cells(table)
    assert {name: after[name] for name in ("camera", "light", "std_m", "r")} == {
        name: before[0][name] for name in ("camera", "light", "std_m", "r")
    }


LANELESS = "1.png,,,,,,0.01,straight,city,6.0,0.2"
"""The row of a picture that shows no lane, with all its cells."""


@pytest.mark.parametrize(
    "row", [LANELESS, "1.png,-1,2.6,-4.6,-1,2.6,0,?,,,", "1.png,,,?,?,?,0,left,,1.25,", None]
)
def test_undo_restores_the_earlier_row_exactly(site: Site, row: str | None) -> None:
    table, path = site.folder / "labels.csv", "/api/pictures/0/label"
    head = "file,ml,mr,l,m,r,angle,heading,drive,pitch_deg,std_m"
    text = f"{head}\n10.png,-1,2.6,,,,0,?,,,0.1\n" + (f"{row}\n" if row else "")
    table.write_text(text)
    before = {cells["file"]: _filled(cells) for _, cells in read_cells(table)}
    changes = [("PUT", LABEL), ("DELETE", None), ("PUT", {**LABEL, "drive": "", "heading": "?"})]
    for changed in (changes[:1], changes[1:2], changes):
        for method, body in changed:
            assert site.ask(method, path, body)[0] == 200
        for _ in changed:
            status, found, _ = site.ask("POST", f"{path}/undo", {})
            assert status == 200 or not row  # removing no label is no change
        assert {cells["file"]: _filled(cells) for _, cells in read_cells(table)} == before
        if row:
            assert _filled(found["row"]) == before["1.png"]
    status, told, _ = site.ask("POST", f"{path}/undo", {})
    assert (status, told["detail"]) == (422, "no earlier label of 1.png is known")


def test_a_label_that_has_changed_since_it_was_shown_is_not_overwritten(site: Site) -> None:
    table, path = site.folder / "labels.csv", "/api/pictures/0/label"
    none = site.ask("GET", "/api/pictures/0")[1]["version"]
    saved = site.ask("PUT", f"{path}?version={none}", LABEL)[1]["version"]
    assert site.ask("GET", "/api/pictures/0")[1]["version"] == saved != none
    kept = table.read_bytes()
    for method, where, body in (
        ("PUT", path, {**LABEL, "ml": -1.0}),
        ("DELETE", path, None),
        ("POST", f"{path}/undo", {}),
    ):
        status, told, _ = site.ask(method, f"{where}?version={none}", body)
        assert (status, told["detail"]) == (
            409,
            "the label of 1.png has changed since it was shown; check the present one",
        )
        assert table.read_bytes() == kept
    # Another row, or a column that another row needs, does not change the version.
    site.ask("PUT", "/api/pictures/1/label", {**LABEL, "light": "dusk"})
    assert site.ask("GET", "/api/pictures/0")[1]["version"] == saved
    table.write_text(table.read_text().replace("1.png,-1.500", "1.png,-1.400"))  # by hand
    assert site.ask("POST", f"{path}/undo?version={saved}", {})[0] == 409
    now = site.ask("GET", "/api/pictures/0")[1]["version"]
    assert site.ask("DELETE", f"{path}?version={now}")[1] == {"row": None, "version": none}
    assert site.ask("POST", f"{path}/undo?version={none}", {})[1]["version"] == now


def test_the_kept_pitch_is_that_of_the_camera_file(site: Site) -> None:
    camera = site.folder / "camera.yaml"
    camera.write_text(camera.read_text().replace("}", ", pitch_deg: 1}"))
    (site.folder / "labels.csv").write_text(
        "file,ml,mr,l,m,r,angle,heading,pitch_deg\n1.png,-1.5,2.1,,,,0.03,?,6\n10.png,,,,,,0,?,5\n"
    )
    shown = [site.ask("GET", f"/api/pictures/{number}")[1] for number in range(3)]
    assert [each["camera_pitch_deg"] for each in shown] == [1.0, 1.0, 1.0]
    # What is drawn has the pitch of the row, also without a lane in the label.
    assert [each["markings"]["pitch_deg"] for each in shown] == [6.0, 5.0, 1.0]
    site.ask("DELETE", "/api/pictures/0/label")
    _, removed, _ = site.ask("GET", "/api/pictures/0")
    assert (removed["row"], removed["camera_pitch_deg"]) == (None, 1.0)
    assert removed["markings"]["pitch_deg"] == 1.0


def test_a_class_that_follows_from_the_lines_is_not_shown_as_chosen(site: Site) -> None:
    cases = [(0.0, "", ""), (0.02, "", ""), (0.0, "left", "left"), (0.02, "?", "?")]
    for curvature, given, shown in cases:
        body = {**LABEL, "curvature": curvature, "heading": given}
        assert site.ask("PUT", "/api/pictures/0/label", body)[0] == 200
        assert site.ask("GET", "/api/pictures/0")[1]["heading"] == shown
    assert site.ask("GET", "/api/pictures/1")[1]["heading"] == ""  # without a label


def test_the_label_of_a_picture_without_a_lane_is_pointed_out(site: Site) -> None:
    head = "file,ml,mr,l,m,r,angle,heading,drive,pitch_deg,std_m"
    (site.folder / "labels.csv").write_text(f"{head}\n{LANELESS}\n")
    _, shown, _ = site.ask("GET", "/api/pictures/0")
    assert (shown["source"], shown["heading"]) == ("usual", "straight")
    assert "the label has no lane" in shown["note"]


def test_a_message_about_a_file_name_that_is_not_utf8_can_be_sent(pictures: Path) -> None:
    (pictures / "1.png").rename(pictures / os.fsdecode(b"0\xff.png"))
    for site in serve(pictures, None):
        status, told, _ = site.ask("POST", "/api/pictures/0/label/undo", {})
        assert (status, told["detail"]) == (422, r"no earlier label of 0\udcff.png is known")


def _filled(cells: dict[str, str]) -> dict[str, str]:
    """Leave out the empty cells: which columns the table has depends on all its rows."""
    return {name: text for name, text in cells.items() if text}

"""The folder of the label page: writes that fail, and file names."""

import errno
import os
from pathlib import Path
from unittest import mock

import pytest

from mtlnet.label.folder import LabelFolder
from tests.mtlnet.label.conftest import TRUE, Site
from tests.mtlnet.label.test_server import LABEL
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


@pytest.mark.parametrize(
    ("number", "detail"),
    [
        (errno.ENOSPC, "the disk is full: labels.csv; free some space"),
        (errno.EROFS, "no permission to write or read: labels.csv; choose another folder"),
        (errno.EIO, "Input/output error: labels.csv"),
    ],
)
def test_a_label_that_cannot_be_written_is_one_line(
    site: Site, number: int, detail: str, capfd: pytest.CaptureFixture[str]
) -> None:
    error = OSError(number, os.strerror(number), str(site.folder.resolve() / "labels.csv"))
    with mock.patch("mtlnet.data.labels_file.atomic_write", side_effect=error):
        status, told, _ = site.ask("PUT", "/api/pictures/0/label", LABEL)
    assert (status, told["detail"][: len(detail)]) == (500, detail)
    assert "Traceback" not in capfd.readouterr().err
    assert site.ask("PUT", "/api/pictures/0/label", LABEL)[0] == 200


@pytest.mark.parametrize("name", [" 1.png", "\xa01.png", "\x851.png", "1\r.png", "\tsub/1.png"])
def test_a_name_that_cannot_be_written_is_refused(pictures: Path, name: str) -> None:
    (pictures / name).parent.mkdir(exist_ok=True)
    (pictures / "1.png").rename(pictures / name)
    with pytest.raises(UserError, match=r"the file name .* cannot be written") as seen:
        LabelFolder(pictures, None, CameraParameters())
    assert repr(name) in str(seen.value)


def test_a_name_with_other_special_characters_is_read_as_it_was_written(pictures: Path) -> None:
    for number, name in enumerate(("a b.png", "a\xa0b.png", 'a",b.png', "a\nb.png", "a\xff.png")):
        (pictures / name).write_bytes((pictures / "1.png").read_bytes())
        folder = LabelFolder(pictures, None, CameraParameters())
        for _ in range(2):
            folder.save(folder.files.index(name), TRUE, "", {})
        assert len(folder.rows()) == number + 1
        assert folder.rows()[name]["file"] == name


def test_the_label_of_a_name_with_a_dot_belongs_to_the_picture(site: Site) -> None:
    table = site.folder / "labels.csv"
    table.write_text("file,ml,mr,l,m,r,angle,heading\n./1.png,-1,2.6,,,,0,?\n")
    assert site.ask("GET", "/api/pictures")[1]["pictures"][0]["labelled"] is True
    assert site.ask("PUT", "/api/pictures/0/label", LABEL)[0] == 200
    assert [line.split(",")[0] for line in table.read_text().splitlines()] == ["file", "1.png"]

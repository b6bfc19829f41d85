"""The folder of the label page: writes that fail, and file names."""

import errno
import os
from unittest import mock

import pytest

from tests.mtlnet.label.conftest import Site
from tests.mtlnet.label.test_server import LABEL


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

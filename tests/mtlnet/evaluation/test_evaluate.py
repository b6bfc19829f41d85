"""Evaluation of a model on a dataset or on pictures: checks before the first frame, counts."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mtlnet.data.picture_copies import COPIES
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.engine import load_engine
from trackfeatures.errors import UserError


@pytest.mark.parametrize("option", ["page", "worst"])
def test_a_file_that_cannot_be_written_is_an_error_before_the_first_frame(
    published: Path, dataset: Path, tmp_path: Path, option: str
) -> None:
    (tmp_path / "file").touch()
    done: list[int] = []
    with pytest.raises((UserError, NotADirectoryError, FileExistsError), match="file"):
        evaluate(
            [load_engine(published, precision="f32")],
            dataset,
            "test",
            lambda count, frames: done.append(count),
            **{option: tmp_path / "file" / "out.html"},  # type: ignore[arg-type]
        )
    assert done == []


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Eight labelled pictures; the camera of every second shows too little of the model's view."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    lines = ["file,ml,mr,l,m,r,angle,heading,camera"]
    for number in range(8):
        camera = ("wide", "narrow")[number % 2]
        lines.append(f"{number}.png,-1.5,2.0,,,,0.02,straight,{camera}.yaml")
        cv2.imwrite(str(folder / f"{number}.png"), np.full((210, 280, 3), 90, np.uint8))
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    (folder / "wide.yaml").write_text("{width: 280, height: 210}\n")
    (folder / "narrow.yaml").write_text("{width: 280, height: 210, fov_y_deg: 4}\n")
    return folder


@pytest.mark.parametrize(("every", "files", "refused"), [(1, 8, 4), (3, 3, 1), (4, 2, 0)])
def test_every_nth_picture_is_counted_with_all_its_copies(
    published: Path, pictures: Path, every: int, files: int, refused: int
) -> None:
    engine = load_engine(published, precision="f32")
    found = evaluate([engine], pictures, "test", every=every, copies="mirrored,turned")["pictures"]
    assert (found["files"], found["cases"], found["refused"]) == (files, 4 * files, 4 * refused)
    counts = {name: (part["cases"], part["refused"]) for name, part in found["by_copy"].items()}
    assert counts == dict.fromkeys(COPIES, (files, refused))


def refused(published: Path, data: Path, match: str, **options: Any) -> None:
    """Assert that an evaluation is refused before its first frame, and that no file changes."""
    files = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match=match):
        evaluate(
            [load_engine(published, precision="f32")],
            data,
            report=lambda count, frames: pytest.fail("a frame was evaluated"),
            **{"split": "test", **options},
        )
    assert files == {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["labels.csv", "0.png", "narrow.yaml"])
def test_a_page_does_not_replace_a_file_of_the_pictures(
    published: Path, pictures: Path, name: str
) -> None:
    refused(published, pictures, f"--report .*{name} is a file to read", page=pictures / name)


@pytest.mark.parametrize("name", ["rounds/r000.mcap", "splits/default.json"])
@pytest.mark.parametrize("option", ["page", "worst"])
def test_an_output_does_not_replace_a_file_of_the_dataset(
    published: Path, dataset: Path, name: str, option: str
) -> None:
    refused(published, dataset, f"{name} is a file to read", **{option: dataset / name})


def test_the_two_outputs_are_two_files(published: Path, dataset: Path, tmp_path: Path) -> None:
    both = {"page": tmp_path / "x", "worst": tmp_path / "y" / ".." / "x"}
    (tmp_path / "y").mkdir()
    refused(published, dataset, "--report and --worst are the same file", **both)


def test_pictures_have_no_split(published: Path, pictures: Path) -> None:
    refused(published, pictures, "--split nonsense is for recorded rounds; all", split="nonsense")

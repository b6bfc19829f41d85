"""Evaluation of a model on a dataset: checks before the first frame."""

from pathlib import Path

import pytest

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

"""Rounds that the split of a dataset does not name are not trained on, and the user is told."""

from pathlib import Path

import pytest

from datagen.recording.splits import Split, split_path, write_split
from mtlnet.data.rounds import open_training_dataset
from tests.mtlnet.conftest import write_dataset


def test_rounds_that_the_split_does_not_name_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = write_dataset(tmp_path)
    open_training_dataset(data)
    assert not caplog.records
    split_path(data).unlink()
    write_split(split_path(data), Split(("r000",), ("r003",)))
    assert len(open_training_dataset(data).select("train").rounds) == 1
    assert f"2 of the 4 rounds of {data} are not used, because its split (" in caplog.text

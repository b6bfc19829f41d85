"""Small files of a dataset folder: replaced atomically, and kept when nothing changes."""

from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.recording.dataset import Dataset
from datagen.recording.errors import DatasetError
from datagen.recording.folder import begin_merge
from datagen.recording.integrity.verify import verify
from datagen.recording.manifest import rebuild
from datagen.recording.split_report import SplitConfig, make_split
from datagen.recording.splits import Split, read_split, split_path, write_split


def test_a_split_is_replaced_atomically_and_an_equal_one_kept(
    dataset: Path, fill_disk: Callable[[], None]
) -> None:
    path = split_path(dataset)
    before = path.stat()
    write_split(path, Split(("r000", "r001"), ("r002",)))
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    fill_disk()
    with pytest.raises(OSError, match="No space left"):
        write_split(path, Split(("r000",), ("r002",)))
    assert read_split(path) == Split(("r000", "r001"), ("r002",))


def test_a_merge_that_has_not_ended_is_refused_by_every_reader(dataset: Path) -> None:
    begin_merge(dataset, ["r000"])
    with pytest.raises(DatasetError, match="running the same `datagen merge` again"):
        Dataset.open(dataset)
    (problem,) = verify(dataset, "quick").problems
    assert "was interrupted" in problem
    with pytest.raises(DatasetError, match="was interrupted"):
        make_split(dataset, "mine", SplitConfig("round", 0.25, 0, False))
    rebuild(dataset, read_split(split_path(dataset)))
    assert verify(dataset, "full").ok

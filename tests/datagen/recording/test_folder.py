"""Small files of a dataset folder: replaced atomically, and kept when nothing changes."""

from pathlib import Path

import pytest

from datagen.recording.folder import write_if_changed
from datagen.recording.splits import Split, read_split, split_path, write_split


def test_a_split_is_replaced_atomically_and_an_equal_one_kept(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = split_path(dataset)
    before = path.stat()
    write_split(path, Split(("r000", "r001"), ("r002",)))
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("runtime.files.fsync_path", full)
    with pytest.raises(OSError, match="No space left"):
        write_split(path, Split(("r000",), ("r002",)))
    assert read_split(path) == Split(("r000", "r001"), ("r002",))


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_if_changed(path, "old")

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("runtime.files.fsync_path", full)
    with pytest.raises(OSError, match="No space left"):
        write_if_changed(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]

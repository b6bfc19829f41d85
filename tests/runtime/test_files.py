"""Atomic writes: replacement in one step, old content after a failure, pipes; locks."""

import errno
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from runtime.files import (
    STAGED,
    atomic_write,
    check_folder,
    file_hash,
    locked_file,
    locked_folder,
    replaced_files,
    require_other_file,
    try_lock,
)
from trackfeatures import UserError


def test_text_and_bytes_replace_the_file_and_leave_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    atomic_write(path, b"old")
    atomic_write(path, "café", fsync=True)
    assert path.read_bytes() == b"caf\xc3\xa9"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_keeps_the_old_file_and_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disk_full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "file.txt"
    path.write_text("old")
    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(OSError, match="No space left") as caught:
        atomic_write(path, "new", fsync=True)
    assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    path, received = tmp_path / "pipe", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: received.append(path.read_bytes()))
    reader.start()
    atomic_write(path, "through")
    reader.join()
    assert received == [b"through"]
    assert path.is_fifo()


def test_a_missing_folder_or_a_folder_as_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no folder"):
        check_folder(tmp_path / "missing" / "file")
    with pytest.raises(UserError, match="is a folder"):
        check_folder(tmp_path)


def test_a_lock_excludes_others_until_its_file_is_closed(tmp_path: Path) -> None:
    """Two file descriptors of one process exclude each other like two processes."""
    first, other = (os.open(tmp_path, os.O_RDONLY) for _ in range(2))
    try:
        assert try_lock(first, shared=True)
        assert try_lock(other, shared=True)
        assert not try_lock(other)
        os.close(first)
        assert try_lock(other)
        first = os.open(tmp_path, os.O_RDONLY)
        assert not try_lock(first, shared=True)
    finally:
        os.close(first)
        os.close(other)


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}


def replace_with(folder: Path, content: str, then: Callable[[], object] = lambda: None) -> None:
    """Replace three files, `card` last; `then` is called after the new files are written."""
    with replaced_files(folder, last="card") as staged:
        for name in ("card", "a", "z"):
            (staged / name).write_text(content)
        then()


def fail(*_: object) -> Path:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_files_that_belong_together_are_replaced_together(tmp_path: Path) -> None:
    (tmp_path / STAGED).mkdir()
    (tmp_path / STAGED / "left").write_text("by a kill")
    (tmp_path / "other").write_text("kept")
    replace_with(tmp_path, "old")
    replace_with(tmp_path, "new", lambda: (tmp_path / "card").read_text() == "old")
    expected = dict.fromkeys(("a", "card", "z"), "new")
    assert contents(tmp_path) == {**expected, "other": "kept"}


def test_files_stay_after_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace_with(tmp_path, "old")
    before = contents(tmp_path)
    with pytest.raises(OSError, match="No space"):
        replace_with(tmp_path, "new", fail)
    monkeypatch.setattr("runtime.files.fsync_path", fail)
    with pytest.raises(OSError, match="No space"):
        replace_with(tmp_path, "new")
    assert contents(tmp_path) == before


def test_without_its_last_file_a_part_is_never_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_with(tmp_path, "old")
    with pytest.raises(OSError, match="No space"):
        replace_with(tmp_path, "new", lambda: monkeypatch.setattr(Path, "replace", fail))
    assert contents(tmp_path) == {"a": "old", "z": "old"}


def test_a_locked_folder_is_refused_to_others_until_the_context_ends(tmp_path: Path) -> None:
    with locked_folder(tmp_path):
        other = pytest.raises(UserError, match="another process is writing to")
        with other, locked_folder(tmp_path):
            pass
    with locked_folder(tmp_path):
        pass


def test_a_locked_file_is_refused_to_others_and_leaves_no_lock(tmp_path: Path) -> None:
    path = tmp_path / "tuned.json"
    with locked_file(path):
        other = pytest.raises(UserError, match=r"another process is writing to .*tuned\.json")
        with other, locked_file(path):
            pass
        path.write_text("{}")
        with locked_file(tmp_path / "other.json"):
            pass
    with pytest.raises(KeyboardInterrupt), locked_file(path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == [path]


def test_the_hash_of_a_file_is_sha_256(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")  # the example of FIPS 180-2, appendix B.1
    assert file_hash(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_an_output_that_is_a_file_to_read_is_refused(tmp_path: Path) -> None:
    read, link, missing = (tmp_path / name for name in ("read.csv", "link.csv", "missing.csv"))
    read.touch()
    link.symlink_to(read)
    for path in (read, link, tmp_path / "." / "read.csv"):
        with pytest.raises(UserError, match=r"--report .* is a file to read; give another one"):
            require_other_file(path, iter([missing, read]), "--report")
    require_other_file(tmp_path / "new.csv", [missing, read])
    require_other_file(tmp_path, [tmp_path])  # a folder, into which new files are written

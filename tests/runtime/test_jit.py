"""Compiled code is found again for the same sources only, and what nobody uses goes."""

import os
import tempfile
import time
from pathlib import Path

import pytest

from runtime.jit import UNUSED_DAYS, code_folder


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    folder = tmp_path / "package" / "inner"
    folder.mkdir(parents=True)
    (folder / "kernel.py").write_text("a = 1\n")
    return folder.parent


def test_other_sources_have_another_folder(package: Path) -> None:
    first = code_folder("ours", package)
    assert first.parent == package.parent / "cache"
    assert code_folder("ours", package) == first
    (package / "inner" / "kernel.py").write_text("a = 2\n")
    assert code_folder("ours", package) != first
    assert first.is_dir()  # a run that began before goes on using it


def test_what_nobody_used_for_a_month_goes(package: Path) -> None:
    used = code_folder("ours", package)
    others = [code_folder(name, package) for name in ("ours-too", "theirs")]
    (used / "kernel.nbc").write_bytes(b"code")
    long_ago = time.time() - (UNUSED_DAYS + 1) * 86_400
    for folder in (used, *others):
        os.utime(folder, (long_ago, long_ago))
    assert code_folder("ours", package) == used  # used again, so kept
    (package / "inner" / "kernel.py").write_text("a = 2\n")
    os.utime(used, (long_ago, long_ago))
    code_folder("ours", package)
    assert not used.exists()
    assert all(folder.is_dir() for folder in others)


def test_without_a_folder_to_write_to_a_temporary_one_serves(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (package.parent / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(package.parent / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(package.parent))
    folder = code_folder("ours", package)
    assert folder.parent == package.parent
    assert os.access(folder, os.W_OK)

"""The folder of compiled code: one for each version of the sources; unused folders are deleted."""

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
    assert first.is_dir()  # an earlier process still uses it


def test_code_unused_for_a_month_is_deleted(package: Path) -> None:
    used = code_folder("ours", package)
    others = [code_folder(name, package) for name in ("ours-too", "theirs")]
    (used / "kernel.nbc").write_bytes(b"code")
    long_ago = time.time() - (UNUSED_DAYS + 1) * 86_400
    for folder in (used, *others):
        os.utime(folder, (long_ago, long_ago))
    assert code_folder("ours", package) == used  # this use updates its time
    (package / "inner" / "kernel.py").write_text("a = 2\n")
    os.utime(used, (long_ago, long_ago))
    code_folder("ours", package)
    assert not used.exists()
    assert all(folder.is_dir() for folder in others)


def test_without_a_writable_folder_a_temporary_one_is_used(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (package.parent / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(package.parent / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(package.parent))
    folder = code_folder("ours", package)
    assert folder.parent == package.parent
    assert os.access(folder, os.W_OK)


def test_the_folder_is_the_users_alone(package: Path) -> None:
    folder = code_folder("ours", package)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)  # the mode of an older version
    assert code_folder("ours", package) == folder
    assert folder.stat().st_mode & 0o777 == 0o700


def test_code_that_others_could_have_planted_is_not_read(package: Path) -> None:
    folder = code_folder("ours", package)
    (folder / "kernel.nbi").write_bytes(b"planted")
    folder.chmod(0o777)
    assert code_folder("ours", package) == folder
    assert not list(folder.iterdir())
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("planted", ["link", "other"])
def test_a_folder_of_another_user_or_a_link_is_not_used(
    package: Path, monkeypatch: pytest.MonkeyPatch, planted: str
) -> None:
    known = code_folder("ours", package)
    kept = package.parent / "theirs"
    known.rename(kept)
    (kept / "kernel.nbi").write_bytes(b"planted")
    if planted == "link":
        known.symlink_to(kept)
    else:
        kept.rename(known)
        monkeypatch.setattr("os.getuid", lambda: known.stat().st_uid + 1)
    found = code_folder("ours", package)
    assert found != known
    assert found.parent == Path(tempfile.gettempdir())
    assert not list(found.iterdir())
    assert found.stat().st_mode & 0o777 == 0o700
    assert found != code_folder("ours", package)  # a random name
    assert (known / "kernel.nbi").read_bytes() == b"planted"


def test_a_user_without_a_home_folder_gets_a_temporary_folder(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example in a container whose user id is not in /etc/passwd."""

    def fail() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", fail)
    assert os.access(code_folder("ours", package), os.W_OK)


def test_a_change_in_any_of_the_packages_has_another_folder(package: Path) -> None:
    other = package.parent / "imported"
    other.mkdir()
    first = code_folder("ours", package, other)
    (other / "definitions.py").write_text("b = 1\n")
    assert code_folder("ours", package, other) != first

"""Writes files atomically (the old file stays until the new one is complete), locks folders, and
converts file names.

A file name can contain any bytes. `os.fsdecode` turns bytes that are not UTF-8 into surrogates, and
text files get surrogates as escapes: the Latin-1 name `caf\\xe9.jpg` becomes `caf\\udce9.jpg`.
"""

import fcntl
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from trackfeatures.errors import UserError

STAGED = ".staged"  # the folder of `replaced_files` for new files


def natural_key(name: str) -> tuple[list[str | tuple[int, str]], str]:
    """Return a sort key of a name that orders numbers by value and ignores case: `frame2` before
    `frame10`, `A1` before `b1`.

    A run of ASCII digits is a number; other digits, signs and decimal points are text.
    """
    parts: list[str | tuple[int, str]] = list(re.split("([0-9]+)", name.casefold()))
    for place in range(1, len(parts), 2):  # every second part has digits, too many for int()
        digits = str(parts[place]).lstrip("0")
        parts[place] = (len(digits), digits)
    return parts, name


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """Yield `path`, or a link to it with a UTF-8 name, for a library that needs UTF-8 names.

    The path is absolute, because FFmpeg takes the `a:` of a relative name `a:b` for a protocol. If
    only the folder's name is not UTF-8, the folder is linked, so that neighbouring files are found.
    """
    whole = Path.cwd() / path
    if str(whole).isprintable():
        yield whole
        return
    with tempfile.TemporaryDirectory(prefix="driverview-") as folder:
        link = Path(folder) / "link"
        if whole.name.isprintable():
            link.symlink_to(whole.parent)
            yield link / whole.name
        else:
            link = link.with_suffix(whole.suffix)
            link.symlink_to(whole)
            yield link


def name_as_text(name: str) -> str:
    """Return a file name as text that can be encoded: bytes that are not UTF-8 become escapes."""
    return name.encode(errors="backslashreplace").decode()


def file_hash(path: Path) -> str:
    """Compute the SHA-256 of a file's bytes, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_folder(path: Path) -> None:
    """Raise UserError if no file can be written to `path`; call it before a long computation."""
    if path.is_dir():
        raise UserError(f"{path} is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise UserError(f"there is no folder {path.parent} to write {path.name} to; make it first")


def require_other_file(path: Path, inputs: Iterable[Path], option: str = "--out") -> None:
    """Raise UserError if the output `path`, given as `option`, is one of the files to read."""
    if path.is_file() and any(path.samefile(source) for source in inputs if source.exists()):
        raise UserError(f"{option} {path} is a file to read; give another one")


def atomic_write(path: Path, content: str | bytes, *, fsync: bool = False) -> None:
    """Replace the file at `path` atomically: write a new file, then rename it. Text is UTF-8.

    If writing fails (a full disk, a power cut) the old file stays. `fsync` waits until the data
    and the new name are on the disk. Raises UserError if the folder is missing, and OSError with
    the file's name if writing fails.
    """
    check_folder(path)
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout must be written to, not replaced.
        path.write_bytes(data)
        return
    partial = unfinished_path(path)
    try:
        partial.write_bytes(data)
        if fsync:
            fsync_path(partial)
        partial.replace(path)
        if fsync:
            fsync_path(path.parent)
    except OSError as error:
        # The OSError of a failed write has no file name; the user needs it.
        error.filename = error.filename or str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: object) -> None:
    """Replace the file at `path` atomically by `content` as indented JSON, and wait until it is on
    the disk. Raises the errors of `atomic_write`."""
    atomic_write(path, json.dumps(content, indent=1) + "\n", fsync=True)


def unfinished_path(path: Path) -> Path:
    """Return the path of the temporary file that `atomic_write` renames to `path`."""
    return path.with_name(path.name + ".partial")


def atomic_move(source: Path, target: Path) -> None:
    """Write the finished file or folder `source` to the disk (fsync), then rename it to `target`.

    After a power cut `target` is complete or does not exist. Raises OSError.
    """
    for path in (*source.rglob("*"), source):
        fsync_path(path)
    source.replace(target)
    fsync_path(target.parent)


@contextmanager
def replaced_files(folder: Path, last: str) -> Iterator[Path]:
    """Yield a temporary folder. At the end of the `with` block its files replace the files of the
    same names in `folder`, unless the block raises an error.

    The file named `last` describes the other files. It is deleted before the first replacement and
    written after the last replacement, so if it exists, all files belong together. Raises OSError.
    """
    staged = folder / STAGED
    shutil.rmtree(staged, ignore_errors=True)  # left by a killed process
    staged.mkdir(parents=True)
    try:
        yield staged
        paths = sorted(staged.iterdir(), key=lambda path: path.name == last)
        for path in paths:
            fsync_path(path)
        (folder / last).unlink(missing_ok=True)
        for path in paths:
            path.replace(folder / path.name)
        fsync_path(folder)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file or folder until it is closed or the process ends (`flock`).

    The lock is exclusive, or shared with `shared`. Returns False if another process holds a lock
    that excludes it: any lock, or with `shared` an exclusive lock.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock `folder` exclusively while the context lasts. The lock also ends if the process ends.

    Raises UserError if another process holds the lock.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not try_lock(descriptor):
            raise _locked(folder)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def locked_file(path: Path) -> Iterator[None]:
    """Like `locked_folder` for a file, which need not exist and may be replaced meanwhile.

    The lock is held on the file `.NAME.lock` in the same folder, which is removed at the end.
    """
    lock = path.with_name(f".{path.name}.lock")
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        # The process that held the lock may have removed this file after it was opened here.
        if not try_lock(descriptor) or os.fstat(descriptor).st_nlink == 0:
            raise _locked(path)
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def _locked(path: Path) -> UserError:
    return UserError(
        f"another process is writing to {path}; wait until it ends, or give another --out"
    )


def fsync_path(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

"""Atomic writes, by which the old file stays until the new one is complete; locks; and an order of
names.

A name can hold any bytes. Those that are not UTF-8 are kept as Python keeps them (`os.fsdecode`),
and a text file gets them as an escape: `caf\\xe9.jpg` of Latin-1 stands as `caf\\udce9.jpg`.
"""

import fcntl
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trackfeatures.errors import UserError

STAGED = ".staged"  # where `replaced_files` keeps new files


def natural_key(name: str) -> tuple[list[str | tuple[int, str]], str]:
    """Sorts names as people count: `frame2` before `frame10`, `b1` after `A1`.

    A run of ASCII digits counts as a number; other digits, signs and points are text.
    """
    parts: list[str | tuple[int, str]] = list(re.split("([0-9]+)", name.casefold()))
    for place in range(1, len(parts), 2):  # every second part is a number, of any length
        digits = str(parts[place]).lstrip("0")
        parts[place] = (len(digits), digits)
    return parts, name


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """`path` for a library that takes UTF-8 names only; else a link to it that has one.

    The path is absolute: to FFmpeg a name like `a:b` has a protocol. Beside the link stands what is
    beside the file, where the name of the file itself is UTF-8.
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


def check_folder(path: Path) -> None:
    """Raise UserError unless a file `path` can be made; to be called before a long computation."""
    if path.is_dir():
        raise UserError(f"{path} is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise UserError(f"there is no folder {path.parent} to write {path.name} to; make it first")


def atomic_write(path: Path, content: str | bytes, *, fsync: bool = False) -> None:
    """Replace the file at `path` in one step, by renaming a file beside it; text becomes UTF-8.

    When writing fails (a full disk, a power cut) the old file stays. `fsync` waits until the data
    and the new name are on the disk. Raises UserError where the folder is missing, OSError with
    the file's name.
    """
    check_folder(path)
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout must not be replaced.
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
        # The error of a failed write lacks the file's name, which the user needs.
        error.filename = error.filename or str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: object) -> None:
    """Replace the file at `path` by `content` in indented JSON; see `atomic_write` with `fsync`."""
    atomic_write(path, json.dumps(content, indent=1) + "\n", fsync=True)


def unfinished_path(path: Path) -> Path:
    """The file that `atomic_write` fills before it renames it to `path`."""
    return path.with_name(path.name + ".partial")


def atomic_move(source: Path, target: Path) -> None:
    """Rename a finished file, or a folder of files, once all of it is on the disk.

    After a power cut `target` is complete or does not exist. Raises OSError.
    """
    for path in (*source.rglob("*"), source):
        fsync_path(path)
    source.replace(target)
    fsync_path(target.parent)


@contextmanager
def replaced_files(folder: Path, last: str) -> Iterator[Path]:
    """Yield a folder; its files replace those in `folder` when the block ends without an error.

    The file `last` describes the others. It is removed before the first of them is replaced, and
    comes after all of them: who finds it finds files that belong together. Raises OSError.
    """
    staged = folder / STAGED
    shutil.rmtree(staged, ignore_errors=True)  # left by a kill
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

    False when another process holds a lock on it (with `shared`: an exclusive one).
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other processes from the folder within the context; a lock ends with its process.

    Raises UserError while another process holds it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not try_lock(descriptor):
            raise UserError(
                f"another process is writing to {folder}; wait for its end, or give another --out"
            )
        yield
    finally:
        os.close(descriptor)


def fsync_path(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

"""The folder that an export goes to: whole or not at all.

It is written beside its place, as `.NAME.partial`, and renamed when complete: a killed export never
looks like one, and the next clears what it left.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from runtime.files import atomic_move
from trackfeatures.errors import UserError


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """A folder to write to that becomes `target` when the block ends without an error.

    Raises UserError where `target` holds something, or another export is writing to it.
    """
    require_free(target)
    partial = target.with_name(f".{target.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(partial, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _own(descriptor, partial, target)
        try:
            _clear(partial)
            yield partial
            require_free(target)
            atomic_move(partial, target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    finally:
        os.close(descriptor)


def require_free(target: Path) -> None:
    """Raise UserError unless `target` is not there yet, or is an empty folder."""
    if not target.name or (target.exists() and not target.is_dir()):
        raise UserError(f"{target} is no folder to write to; give another --out")
    if target.is_dir() and any(target.iterdir()):
        raise UserError(f"{target} is not empty; remove it or give another --out")


def _own(descriptor: int, partial: Path, target: Path) -> None:
    """The lock ends with the process; a folder renamed meanwhile is another's finished export."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        mine = partial.exists() and partial.stat().st_ino == os.fstat(descriptor).st_ino
    except BlockingIOError:
        mine = False
    if not mine:
        raise UserError(f"another `datagen export` is writing to {target}; give another --out")


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()

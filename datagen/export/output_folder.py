"""Writes the output folder of an export atomically.

The folder is written as `.NAME.partial` beside the target and renamed when it is complete. So a
killed export leaves no folder that looks complete. The next export deletes the partial folder.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from runtime.files import atomic_move, try_lock
from trackfeatures.errors import UserError


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield a folder to write to, which becomes `target` when the block ends without an error.

    Raises UserError if `target` is not empty or another export is writing to it.
    """
    require_free(target)
    partial = target.with_name(f".{target.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(partial, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _lock(descriptor, partial, target)
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
    """Raise UserError unless `target` does not exist or is an empty folder."""
    if not target.name or (target.exists() and not target.is_dir()):
        raise UserError(f"{target} is no folder to write to; give another --out")
    if target.is_dir() and any(target.iterdir()):
        raise UserError(f"{target} is not empty; remove it or give another --out")


def _lock(descriptor: int, partial: Path, target: Path) -> None:
    """Lock the folder `partial` until its `descriptor` is closed. Raises UserError, which names
    `target`, if another export uses `partial` or has renamed it to `target`."""
    is_ours = try_lock(descriptor) and partial.exists()
    if not is_ours or partial.stat().st_ino != os.fstat(descriptor).st_ino:
        raise UserError(f"another `datagen export` is writing to {target}; give another --out")


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()

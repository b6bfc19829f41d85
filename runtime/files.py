"""Atomic writes: a file is replaced in one step, and the old one stays until then."""

import os
from pathlib import Path

from trackfeatures.errors import UserError


def check_folder(path: Path) -> None:
    """Raise UserError unless a file `path` can be made; to be called before a long computation."""
    if path.is_dir():
        raise UserError(f"{path} is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise UserError(f"there is no folder {path.parent} to write {path.name} to; make it first")


def atomic_write(path: Path, content: str | bytes, *, fsync: bool = False) -> None:
    """Replace the file at `path` in one step, by renaming a file beside it; text becomes UTF-8.

    When writing fails (a full disk, a power cut) the old file stays. `fsync` waits until the data
    is on the disk. Raises UserError where the folder is missing, OSError with the file's name.
    """
    check_folder(path)
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout must not be replaced.
        path.write_bytes(data)
        return
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write(data)
            if fsync:
                file.flush()
                os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        # The error of a failed write lacks the file's name, which the user needs.
        error.filename = error.filename or str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)

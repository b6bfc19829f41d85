"""Files of a run, written whole or not at all: a full disk or a power cut leaves the old one."""

import os
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Put `content` into `path`, through a file beside it that is removed when that fails."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        # A failed write does not know its file's name, which the user needs.
        error.filename = error.filename or str(path)
        raise

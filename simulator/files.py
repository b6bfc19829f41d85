"""Files are written whole or not at all: an older one stays until the new one is complete."""

from pathlib import Path

from trackfeatures.errors import UserError


def check_folder(path: Path) -> None:
    """Raises UserError where `path` cannot be written for want of its folder; ask before long work.

    A pipe or a device is written to where it is.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise UserError(f"there is no folder {path.parent} to write {path.name} to; make it first")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file in one go, text as UTF-8. Raises UserError without its folder, or OSError."""
    check_folder(path)
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout cannot be replaced, and must not be.
        path.write_bytes(data)
        return
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)

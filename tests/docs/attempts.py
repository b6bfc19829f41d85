"""Attempts that the program must refuse: functions of an empty folder, by the first words of their
row on the page "What is refused, and why"."""

from collections.abc import Callable
from pathlib import Path

Try = Callable[[Path], object]


def add_to(tries: dict[str, Try], words: str) -> Callable[[Try], Try]:
    """Adds the decorated attempt to `tries`."""

    def add(function: Try) -> Try:
        tries[words] = function
        return function

    return add


def written(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path

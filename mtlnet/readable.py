"""Images that cannot be decoded, found before a run that would meet them after an hour."""

from pathlib import Path

import numpy as np

from datagen.recording import Dataset, DatasetError, Frames, UndecodableImage

CHUNK = 64  # images at a time
NAMED = 5


def undecodable(frames: Frames) -> dict[int, UndecodableImage]:
    """Which frames have an image that cannot be decoded, and why; all are decoded."""
    images = np.empty((CHUNK, frames.camera.height, frames.camera.width, 3), np.uint8)
    found: dict[int, UndecodableImage] = {}
    for first in range(0, len(frames), CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(frames)))
        try:
            frames.read_batch(rows, images[: len(rows)])
        except UndecodableImage:
            found.update(_each(frames, rows.tolist()))
    return found


def _each(frames: Frames, rows: list[int]) -> dict[int, UndecodableImage]:
    found = {}
    for row in rows:
        try:
            frames.image(row)
        except UndecodableImage as error:
            found[row] = error
    return found


def require_decodable(frames: Frames, data: Path, *, skippable: bool = False) -> None:
    """Raise DatasetError that counts and names the images that cannot be decoded.

    `skippable`: the command has --skip-undecodable.
    """
    found = list(undecodable(frames).values())
    if not found:
        return
    named = ", ".join(f"image {e.frame} of round {e.round_id}" for e in found[:NAMED])
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    skip = ", or leave these frames out with --skip-undecodable" if skippable else ""
    raise DatasetError(
        f"{len(found)} of {len(frames)} images in {data} cannot be decoded: {named}{more} "
        f"({found[0].reason}); record those rounds again{skip}"
    )


def decodable(frames: Frames, data: Path) -> tuple[Frames, list[str]]:
    """`frames` without those that cannot be decoded, and the names of these.

    Raises DatasetError when none are left.
    """
    found = undecodable(frames)
    if len(found) == len(frames):
        require_decodable(frames, data)
    names = [f"{error.round_id}/{error.frame}" for error in found.values()]
    return frames.without(found) if found else frames, names


def require_all_decodable(dataset: Dataset, sides: tuple[str, ...]) -> None:
    """Raise DatasetError unless every image of these sides of a split can be decoded."""
    for side in sides:
        require_decodable(dataset.select(side), dataset.path)

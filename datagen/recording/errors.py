"""Errors of recordings and dataset folders."""

from pathlib import Path

from trackfeatures.errors import UserError

MAKE_AGAIN = (
    "run the command that made the dataset (such as `datagen collect`, `datagen merge`) again"
)


class DatasetError(UserError):
    """A dataset folder or one of its rounds cannot be read, or must not be used as it is."""


class UndecodableImage(DatasetError):
    """Image number `frame` of the round `round_id` cannot be decoded; `reason` is the cause."""

    def __init__(self, round_id: str, path: Path, frame: int, reason: str) -> None:
        super().__init__(
            f"image {frame} of {path} cannot be read: {reason}; run `datagen verify --level deep` "
            "on the dataset, and record the round again or save its undamaged frames with "
            "`datagen recover`"
        )
        self.round_id, self.frame, self.reason = round_id, frame, reason

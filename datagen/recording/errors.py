"""What can be wrong with a recording or a dataset folder."""

from pathlib import Path

from trackfeatures.errors import UserError


class DatasetError(UserError):
    """A dataset folder or one of its rounds cannot be read, or must not be used as it is."""


class UndecodableImage(DatasetError):
    """One image that cannot be decoded: image `frame` of the round called `round_id`, and why."""

    def __init__(self, round_id: str, path: Path, frame: int, reason: str) -> None:
        super().__init__(
            f"image {frame} of {path} cannot be read: {reason}; run `datagen verify --level deep` "
            "on the dataset and record the round again"
        )
        self.round_id, self.frame, self.reason = round_id, frame, reason

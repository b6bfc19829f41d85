"""Errors of a collection; `datagen.recording.errors` has the errors of the dataset format."""

from trackfeatures.errors import UserError


class RoundFailed(UserError):
    """The driver cannot complete this round. Another attempt would fail in the same way."""

"""Errors of `datagen collect`; `datagen.recording.errors` has the errors of the dataset format."""

from trackfeatures.errors import UserError


class RoundFailed(UserError):
    """The driver cannot complete a round. Another attempt would fail in the same way."""

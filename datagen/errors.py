"""Errors of collecting; those of the dataset format are in `datagen.recording.errors`."""

from trackfeatures.errors import UserError


class RoundFailed(UserError):
    """The driver cannot complete this round. Another attempt would fail in the same way."""

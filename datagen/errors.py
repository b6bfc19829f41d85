"""What can go wrong while a dataset is collected, beyond what `datagen.recording` knows."""

from trackfeatures.errors import UserError


class RoundFailed(UserError):
    """The driver cannot drive this round: with the same plan it never will."""

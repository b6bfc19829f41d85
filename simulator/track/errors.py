"""What can be wrong with a track the user names or brings."""

from trackfeatures.errors import UserError


class UnknownTrack(UserError):  # says what it is; "Error" would add nothing
    """No track of that name is found anywhere we look."""


class TrackError(UserError):
    """A track file that cannot be read, or does not describe a closed road."""

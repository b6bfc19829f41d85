"""Errors of tracks that a user names or supplies."""

from trackfeatures.errors import UserError


class UnknownTrack(UserError):
    """Raised if no track of this name is found."""


class TrackError(UserError):
    """Raised if a track file cannot be read or does not describe a closed road."""

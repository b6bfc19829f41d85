"""Errors of tracks that a user names or supplies."""

from trackfeatures.errors import UserError


class UnknownTrack(UserError):
    """No track of that name was found."""


class TrackError(UserError):
    """A track file cannot be read, or does not describe a closed road."""

"""Errors of the simulated world."""

from trackfeatures.errors import UserError


class ContactsUnavailable(UserError):
    """The car touched something, and PyBullet, which computes contacts, is not installed.

    The episode cannot go on; a reset begins a new one.
    """

"""Errors of the simulated world."""

from trackfeatures.errors import UserError


class ContactsUnavailable(UserError):
    """Raised if the car touches something and PyBullet, which computes contacts, is not installed.

    The episode cannot continue; a reset begins a new one.
    """

"""Errors caused by the input, each reported in one line."""

from trackfeatures.definitions import VERSION


class UserError(Exception):
    """A problem the user can fix; the message gives what was seen, expected, and what to do."""


class DefinitionsMismatch(UserError):
    """Data or a model made with another version of the track-feature definitions."""


def require_version(found: str, what: str) -> None:
    """Raise DefinitionsMismatch unless `what` was made with this version of the definitions."""
    if found != VERSION:
        raise DefinitionsMismatch(
            f"{what} was made with version {found!r} of the track-feature definitions, this "
            f"program has version {VERSION!r}; make it again with this program, or use the program "
            "it was made with"
        )

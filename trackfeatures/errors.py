"""Errors that the user's input causes; commands report each in one line."""

from trackfeatures.definitions import VERSION


class UserError(Exception):
    """A problem that the user can fix; the message says what was seen, what was expected, what to
    do."""


class DefinitionsMismatch(UserError):
    """Data or a model made with another version of the track-feature definitions."""


def require_version(found: str, what: str) -> None:
    """Raise DefinitionsMismatch unless `what` was made with this version of the definitions."""
    if found != VERSION:
        raise DefinitionsMismatch(
            f"{what} was made with version {found!r} of the track-feature definitions, but this "
            f"program has version {VERSION!r}; make it again with this program, or use the program "
            "that made it"
        )

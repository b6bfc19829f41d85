"""Errors that the user's input causes; commands report each of them in one line."""

from trackfeatures.definitions import VERSION


class UserError(Exception):
    """Base class of problems that the user can fix. The message states what was found, what was
    expected, and what to do."""


class DefinitionsMismatch(UserError):
    """Raised for data or a model made with another version of the track-feature definitions."""


def require_version(found: str, what: str) -> None:
    """Raises DefinitionsMismatch unless `found`, the version of the definitions with which `what`
    was made, is this program's version."""
    if found != VERSION:
        raise DefinitionsMismatch(
            f"{what} was made with version {found!r} of the track-feature definitions, but this "
            f"program has version {VERSION!r}; make it again with this program, or use the program "
            "that made it"
        )

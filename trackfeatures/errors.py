"""What goes wrong because of what the user gave us, said in one line each."""

from trackfeatures.definitions import VERSION


class UserError(Exception):
    """A problem the user can mend: it says what was seen, what was expected and what to do."""


class DefinitionsMismatch(UserError):
    """Data or a model made with another version of the track-feature definitions."""


def require_version(found: str, what: str) -> None:
    """Raise DefinitionsMismatch unless `what` was made with the definitions in force."""
    if found != VERSION:
        raise DefinitionsMismatch(
            f"{what} was made with version {found!r} of the track-feature definitions, this "
            f"program has version {VERSION!r}; make it again with this program, or use the program "
            f"it came from"
        )

"""What goes wrong because of what the user gave us, said in one line each."""


class UserError(Exception):
    """A problem the user can mend: the message says what was seen, what was expected, what to do."""


class DefinitionsMismatch(UserError):  # noqa: N818  # a mismatch, as DESIGN names it
    """Data or a model made with another version of the track-feature definitions."""

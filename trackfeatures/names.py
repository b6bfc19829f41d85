"""Checks names read from files, for example a round's id, before they become part of a path.

A dataset or a model can come from an untrusted source. A name read from it must never lead outside
the folder in which a file of this name is written or deleted.
"""

import re

from trackfeatures.errors import UserError

MAX_LENGTH = 128  # characters
NAME = re.compile(rf"[A-Za-z0-9._-]{{1,{MAX_LENGTH}}}")
OTHER = re.compile(r"[^A-Za-z0-9._-]")


class BadName(UserError, ValueError):
    """Raised for a name with forbidden characters or of forbidden length."""


def is_name(value: object) -> bool:
    """Return whether `value` is a text of 1 to 128 characters, each an ASCII letter, a digit, `.`,
    `_` or `-`, and is neither `.` nor `..`."""
    return isinstance(value, str) and NAME.fullmatch(value) is not None and value not in (".", "..")


def require_name(value: object, what: str) -> str:
    """Return `value` if `is_name` accepts it, else raise BadName. `what` describes the value in the
    message."""
    if not is_name(value):
        raise BadName(
            f"the {what} is {str(value)[:80]!r}; expected a name of letters, digits, '.', '_' and "
            f"'-', {MAX_LENGTH} characters at most"
        )
    return str(value)


def to_name(text: str) -> str:
    """Return `text` with `-` in place of every forbidden character, cut to 128 characters;
    "unnamed" if the result is empty, `.` or `..`."""
    found = OTHER.sub("-", text)[:MAX_LENGTH]
    return found if is_name(found) else "unnamed"

"""Names read from files: accepted and refused values."""

import pytest

from trackfeatures.errors import UserError
from trackfeatures.names import is_name, require_name, to_name

BAD = ["", ".", "..", "/etc", "../x", "a/b", "a\\b", "a b", "a\n", "é", "x" * 129, None, 3, ["a"]]


@pytest.mark.parametrize("name", ["round-000", "a", "A_1.b-c", "...", ".partial", "x" * 128])
def test_names_are_kept(name: str) -> None:
    assert require_name(name, "round id") == name
    assert to_name(name) == name


@pytest.mark.parametrize("value", BAD)
def test_everything_else_is_refused(value: object) -> None:
    assert not is_name(value)
    with pytest.raises(UserError, match="the round id is"):
        require_name(value, "round id")
    with pytest.raises(ValueError, match="expected a name"):
        require_name(value, "round id")


def test_text_becomes_a_name() -> None:
    assert to_name("my run/é") == "my-run--"
    assert to_name("..") == to_name("") == "unnamed"
    assert is_name(to_name("x" * 500))

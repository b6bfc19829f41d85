"""The page "What is refused, and why": each of its rows is tried, with its class and message."""

import re
from pathlib import Path

import pytest

from docs.generate import error_classes
from tests.docs import refused_by_simulator, refused_inputs
from trackfeatures.errors import UserError

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "errors.md").read_text()
ROWS = [
    [cell.strip().strip("`") for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("| ") and not line.startswith("| input")
]
TRIES = refused_inputs.TRIES | refused_by_simulator.TRIES


@pytest.mark.parametrize("row", ROWS, ids=lambda cells: cells[0][:40])
def test_each_row_is_refused_with_its_class_and_message(row: list[str], tmp_path: Path) -> None:
    words, name, message, _ = row
    (attempt,) = (made for start, made in TRIES.items() if words.startswith(start))
    with pytest.raises(UserError, match=re.escape(message)) as refused:
        attempt(tmp_path)
    assert type(refused.value).__name__ == name


def test_the_page_holds_every_case_and_no_class_that_does_not_exist() -> None:
    assert len(ROWS) == len(TRIES) > 30
    classes = error_classes()
    assert {name for _, name, _, _ in ROWS} <= set(classes)
    assert all(about for _, _, about in classes.values())
    assert "<!-- generated: errors -->" in PAGE

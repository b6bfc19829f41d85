"""The table "attack, promise, test": its tests exist, and it holds every attack."""

import re
from pathlib import Path

import pytest

from tests.serve.attacks.registry import ATTACKS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "threat-model.md").read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.partition("## Attack, promise, test")[2].splitlines()
    if line.startswith("|") and not line.startswith(("|---", "| attack"))
]


def test_each_row_has_an_attack_a_promise_and_a_test() -> None:
    assert len(ROWS) > 30
    for row in ROWS:
        assert len(row) == 4, row
        attack, _, promise, test = row
        assert attack, row
        assert promise, row
        assert (ROOT / "tests" / test.strip("`")).is_file(), row


def test_the_table_holds_every_attack_once_and_no_other() -> None:
    named = [name for row in ROWS for name in re.findall(r"`(\w+)`", row[1])]
    assert sorted(named) == sorted(attack.__name__ for attack in ATTACKS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:40])
def test_the_test_of_an_attack_makes_it(row: list[str]) -> None:
    """The test names the attack, or runs all attacks of `costs`."""
    text = (ROOT / "tests" / row[3].strip("`")).read_text()
    everything = (ROOT / "tests" / "serve" / "attacks" / "test_each_attack.py").read_text()
    costs = (ROOT / "tests" / "serve" / "attacks" / "costs.py").read_text()
    for name in re.findall(r"`(\w+)`", row[1]):
        made = re.search(rf"\b{name}\b", text + everything) or f"def {name}(" in costs
        assert made, f"{name} is in no test"

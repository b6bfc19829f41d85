"""Results and experiments: tables follow from docs/results.toml; sections have dates."""

import re
import tomllib
from pathlib import Path

import pytest

from docs import results

EXPERIMENTS = results.ROOT / "docs" / "experiments"
DATA = tomllib.loads(results.SOURCE.read_text())
PAGES = sorted(path for path in EXPERIMENTS.glob("*.md") if path.name != "index.md")


def slug(title: str) -> str:
    """The anchor that MkDocs and GitHub give a heading of ASCII words."""
    return re.sub(r"[^a-z0-9_ -]", "", title.lower()).replace(" ", "-")


def sections(page: Path) -> dict[str, str]:
    """The text under each heading of the second level, by anchor."""
    parts = re.split(r"^## (.*)\n", page.read_text(), flags=re.M)
    titles, texts = parts[1::2], parts[2::2]
    assert len({slug(title) for title in titles}) == len(titles), f"{page.name}: equal titles"
    return dict(zip(map(slug, titles), texts, strict=True))


def test_readme_and_results_hold_the_tables_of_the_file() -> None:
    pages = results.pages(DATA)
    assert {path.name for path in pages} == {"README.md", "results.md"}
    for path, text in pages.items():
        assert path.read_text() == text, f"{path.name}: run `python docs/results.py`"


def test_a_changed_figure_changes_both_pages() -> None:
    changed = [{**DATA["result"][0], "figure": "0.123 m"}, *DATA["result"][1:]]
    for path, text in results.pages({**DATA, "result": changed}).items():
        assert text.count("0.123 m") == path.read_text().count("0.123 m") + 1


def test_a_target_says_who_set_it_and_whether_it_is_reached() -> None:
    named = {result["set"] for result in DATA["result"] if "target" in result}
    assert named == set(DATA["targets"])
    for result in DATA["result"]:
        assert ("target" in result) == ("set" in result) == ("outcome" in result), result["id"]
        assert result.get("outcome", "reached").split()[0] in ("reached", "missed"), result["id"]
    ids = [result["id"] for result in DATA["result"]]
    assert len(set(ids)) == len(ids)


def test_a_page_without_the_table_is_an_error() -> None:
    with pytest.raises(ValueError, match="no table after '## A'"):
        results.with_table("## A\n\ntext\n\n## B\n\n| a |\n|---|\n", "## A", "| b |")


def test_links_to_experiments_name_a_section() -> None:
    anchors = {page.name: set(sections(page)) for page in [*PAGES, EXPERIMENTS / "index.md"]}
    for result in DATA["result"]:
        page, _, anchor = result["experiment"].partition("#")
        assert anchor in anchors[page], result["id"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_an_experiment_has_a_question_an_answer_and_dates(page: Path) -> None:
    text = page.read_text()
    assert re.match(r"# .+\n\n\*\*Question\.\*\* .+\n\n\*\*Answer\.\*\* ", text)
    assert f"]({page.name})" in (EXPERIMENTS / "index.md").read_text()
    for anchor, section in sections(page).items():
        assert re.search(r"2026-\d\d-\d\d", section), f"{page.name}#{anchor} has no date"

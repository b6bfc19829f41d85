"""Writes the tables of docs/results.md and the table of README.md from docs/results.toml.

python docs/results.py
"""

import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "docs" / "results.toml"
SUMMARY_HEADER = "| measured today ([more](docs/results.md)) | driverview | the paper |"

Result = dict[str, Any]
"""One `[[result]]` of the file; its header lists the keys."""


def pages(data: dict[str, Any]) -> dict[Path, str]:
    """The pages that hold tables, with the tables that follow from `data`, by path."""
    readme = ROOT / "README.md"
    page = ROOT / "docs" / "results.md"
    text = with_table(page.read_text(), "## Targets", targets_table(data["targets"]))
    for section in dict.fromkeys(result["section"] for result in data["result"]):
        rows = [result for result in data["result"] if result["section"] == section]
        text = with_table(text, f"## {section}", results_table(rows))
    summary = with_table(readme.read_text(), "## Results", summary_table(data["result"]))
    return {page: text, readme: summary}


def summary_table(results: list[Result]) -> str:
    """The README's table: the results that have a `readme` name."""
    rows = [_row(r["readme"], r["figure"], r["paper"]) for r in results if "readme" in r]
    return "\n".join([SUMMARY_HEADER, "|---|---|---|", *rows])


def targets_table(targets: dict[str, dict[str, str]]) -> str:
    """Who set the targets of each name, and why."""
    rows = [_row(name, target["set_by"], target["why"]) for name, target in targets.items()]
    return "\n".join(["| name | set by | why |", "|---|---|---|", *rows])


def results_table(results: list[Result]) -> str:
    """The results of a section; the paper's column is left out where it would be empty."""
    with_paper = any("paper" in result for result in results)
    header = ["what", "figure", "target", *["the paper"] * with_paper, "command", "experiment"]
    rows = []
    for result in results:
        page, _, _ = result["experiment"].partition(".md")
        link = f"[{page}](experiments/{result['experiment']})"
        paper = [result.get("paper", "")] * with_paper
        cells = [result["what"], result["figure"], _target(result), *paper]
        command = f"`{result['command']}`" if "command" in result else "not kept"
        rows.append(_row(*cells, command, link))
    return "\n".join([_row(*header), "|---" * len(header) + "|", *rows])


def _target(result: Result) -> str:
    if "target" not in result:
        return ""
    missed = result["outcome"].startswith("missed")
    outcome = f"**{result['outcome']}**" if missed else result["outcome"]
    return f"{result['target']} ([{result['set']}](#targets)): {outcome}"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def with_table(text: str, heading: str, table: str) -> str:
    """The text with the first table after `heading` replaced; no such table is a ValueError."""
    lines = text.splitlines()
    first = lines.index(heading)
    while not lines[first].startswith("|"):
        first += 1
        if first == len(lines) or lines[first].startswith("#"):
            raise ValueError(f"no table after {heading!r}")
    last = first
    while last < len(lines) and lines[last].startswith("|"):
        last += 1
    return "\n".join([*lines[:first], table, *lines[last:]]) + "\n"


if __name__ == "__main__":
    for path, content in pages(tomllib.loads(SOURCE.read_text())).items():
        path.write_text(content)

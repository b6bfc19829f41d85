"""`make docs` builds the pages, and a broken link fails it."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("target", "fails"), [("there.md", False), ("gone.md", True)])
def test_a_broken_link_fails_the_build(target: str, fails: bool, tmp_path: Path) -> None:
    show = ["make", "-n", "docs", f"BIN={Path(sys.executable).parent}"]
    shown = subprocess.run(show, cwd=ROOT, capture_output=True, text=True, check=True)
    command = shown.stdout.splitlines()[-1]
    assert "mkdocs build" in command
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    kept = {name: settings[name] for name in ("site_name", "docs_dir", "site_dir", "validation")}
    (tmp_path / "mkdocs.yml").write_text(yaml.safe_dump({**kept, "theme": "mkdocs"}))
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/index.md").write_text(f"A [page]({target}).\n")
    (tmp_path / "docs/there.md").write_text("Another page.\n")
    built = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (built.returncode != 0) is fails, built.stderr
    assert ("gone.md" in built.stderr) is fails

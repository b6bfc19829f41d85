"""The README's programs with environments run, and its table lists every option."""

import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from simulator.env import OPTIONS

README = (Path(__file__).parents[3] / "README.md").read_text()
SECTION = README.split("\n## Environments\n")[1].split("\n## ")[0]
PROGRAMS = re.findall(r"```python\n(.*?)```", SECTION, flags=re.DOTALL)


@pytest.mark.parametrize("number", range(4))
def test_the_programs_run(number: int, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", PROGRAMS[number]],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    videos = list(tmp_path.glob("videos/*.mp4"))
    assert len(videos) == PROGRAMS[number].count("RecordVideo")


def test_the_table_names_every_option() -> None:
    rows = [line.split("|")[1] for line in SECTION.splitlines() if line.startswith("| `")]
    named = set(re.findall(r"`(\w+)`", " ".join(rows)))
    options = {field.name for group in OPTIONS for field in fields(group)}
    assert named == options | {"render_mode", "max_episode_steps"}
    assert len(PROGRAMS) == 4

"""The phases in which `benchmarks/collect_killed.py` kills collections."""

from pathlib import Path

from benchmarks.collect_killed import phase
from runtime.files import unfinished_path


def test_the_phase_follows_from_the_files(tmp_path: Path) -> None:
    unfinished_path(tmp_path / "plan.json").write_text("{")
    assert phase(tmp_path) == "planning"
    (tmp_path / "plan.json").write_text('{"rounds": [0, 1]}')
    unfinished_path(tmp_path / "plan.json").unlink()
    assert phase(tmp_path) == "starting up"
    (tmp_path / ".partial/round-000").mkdir(parents=True)
    assert phase(tmp_path) == "beginning a round"
    (tmp_path / ".partial/round-000/round.mcap").write_text("x")
    assert phase(tmp_path) == "recording or checking"
    (tmp_path / "state").mkdir()
    unfinished_path(tmp_path / "state/round-000.json").write_text("{")
    assert phase(tmp_path) == "writing a small file"

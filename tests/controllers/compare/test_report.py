"""The report of a comparison: its table, its page and its curves."""

from pathlib import Path
from typing import Any

from controllers.compare.config import CompareConfig
from controllers.compare.curves import CurveRecorder
from controllers.compare.report import driving_curves, score_table, spread, write_report
from controllers.compare.run import compare
from controllers.perception.perceived import Perceived
from tests.controllers.fake_world import at_rest
from trackfeatures import RoadClass


def entry(track: str, controller: str, seed: int, score: float, steps: int) -> dict[str, Any]:
    result = {"score_per_step": score, "steps_asked": steps, "ended": None}
    return {"track": track, "controller": controller, "seed": seed, "result": result}


def test_the_table_has_means_spreads_and_the_papers_scores() -> None:
    drives = [entry("forza", "lqr", seed, 0.99 + 0.002 * seed, 6500) for seed in range(3)]
    drives += [entry("oval", "mpc", 0, 0.9, 100)]
    head, rows = score_table(drives)
    assert head == ["track", "lqr", "mpc", "paper: LQR", "paper: MPC", "paper: RL"]
    assert rows[0] == ["forza (6500 steps)", "0.9920 ± 0.0020", "-", "0.9748", "0.9766", "0.9808"]
    assert rows[1] == ["oval (100 steps)", "-", "0.9000", "-", "-", "-"]
    other = [entry("forza", "lqr", 0, 0.99, 100)]
    assert score_table(other)[0] == ["track", "lqr"]
    assert spread([1.0], 1) == "1.0"


def test_the_page_shows_the_scores_and_curves(tmp_path: Path) -> None:
    out = tmp_path / "comparison"
    config = CompareConfig(out, tracks="oval", controllers="lqr,torcs", steps=60, seeds=2)
    content = compare(config)
    page = write_report(config.out, content).read_text()
    head, rows = score_table(content["drives"])
    assert all(cell in page for cell in (*head, *rows[0]))
    assert page.count("<svg") == 2 * 2  # offset and angle of the first seed of two controllers
    assert "lqr on oval" in page


def test_curves_keep_the_peak() -> None:
    recorder = CurveRecorder()
    for step in range(2000):
        peak = step == 777
        state = at_rest(time_s=step * 0.05, to_middle=1.5 if peak else 0.1, angle=0.02)
        recorder(state, Perceived(None if peak else 0.12, 0.03, RoadClass.LEFT), 0.5)
    curves = recorder.curves()
    assert len(curves["t"]) == 400
    assert max(value for value in curves["d"] if value is not None) == 1.5
    assert curves["perceived_d"][curves["d"].index(1.5)] is None
    assert driving_curves(curves)[0].count("<path") >= 2

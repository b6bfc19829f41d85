"""The demo: choice of frames, limit checks, child processes."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from controllers.demo.config import DemoConfig
from controllers.demo.frames import PostedFrame, spread
from controllers.demo.process import run_module
from controllers.demo.report import check_drive, check_evaluation, check_posted, print_tables
from controllers.demo.run import announce, run_demo
from tests.typed import typed
from trackfeatures import UserError

NOTHING = dict.fromkeys(("ml", "mr", "l", "m", "r"))


class FakeFrames:
    """The round of each frame, which is all that `spread` reads."""

    class labels:  # noqa: N801  # stands for an attribute
        round = np.repeat([3, 4, 9], [50, 5, 50])


def test_frames_are_chosen_from_every_round() -> None:
    chosen = spread(FakeFrames, 12, np.random.default_rng(1))  # type: ignore[arg-type]  # a fake
    assert len(set(chosen)) == 12
    assert np.bincount(FakeFrames.labels.round[chosen]).tolist() == [0, 0, 0, 4, 4, 0, 0, 0, 0, 4]


def evaluation(angle: float = 0.02, ml: float = 0.2, heading: float = 0.9) -> dict[str, Any]:
    mae = {"ml": ml, "mr": 0.2, "l": None, "m": 0.9, "r": 0.9}
    mean = {"ml": 0.5, "mr": 0.5, "l": None, "m": 0.5, "r": 0.5}
    baseline = {"mae_m": mean, "angle_mae_rad": 0.04, "heading_accuracy": 0.5}
    return {
        "mae_m": mae,
        "angle_mae_rad": angle,
        "heading_accuracy": heading,
        "baseline": baseline,
    }


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, []),
        ({"ml": 0.36}, ["ml (m)"]),
        ({"ml": 0.33}, ["ml (m)"]),  # below 0.35 m, but above 0.65 of the baseline's 0.5 m
        ({"angle": 0.027}, ["angle (rad)"]),
        ({"heading": 0.84}, ["heading (share right)"]),
    ],
)
def test_a_limit_also_requires_a_share_of_the_mean_predictors_error(
    change: dict[str, float], missed: list[str]
) -> None:
    found = check_evaluation(evaluation(**change))
    assert [one.what for one in found] == [
        *("ml (m)", "mr (m)", "m (m)", "r (m)", "angle (rad)", "heading (share right)")
    ]
    assert [one.what for one in found if not one.reached] == missed


def test_tables_show_true_and_answered_values(capsys: pytest.CaptureFixture[str]) -> None:
    answer = {
        "distances_m": {**NOTHING, "ml": -1.5, "mr": 2.5},
        "to_lane_centre_m": 0.5,
        "angle_rad": 0.012,
        "heading": {"left": 0.1, "straight": 0.2, "right": 0.7},
    }
    distances = {**NOTHING, "ml": -1.6, "mr": 2.4}
    asked = PostedFrame(b"", "r1", "oval", 2, distances, 0.4, 0.01, "straight", 0.0, answer)
    print_tables(check_evaluation(evaluation(angle=0.05)), [asked])
    output = capsys.readouterr().out
    for cell in ("-1.60 -1.50", "+0.40 +0.50", "+0.010 +0.012", "straight right", "1.25 ", "NO"):
        assert cell in output


@pytest.mark.parametrize(
    ("drive", "reached"),
    [
        ({"mean_abs_d_m": 0.29, "ended": None}, True),
        ({"mean_abs_d_m": 0.31, "ended": None}, False),
        ({"mean_abs_d_m": 0.1, "ended": "off_road"}, False),
    ],
)
def test_a_drive_must_stay_on_the_road_near_the_middle(
    drive: dict[str, Any], reached: bool
) -> None:
    assert check_drive(drive).reached is reached


def test_posted_answers_must_be_as_good_as_the_evaluation_says() -> None:
    limits = {"errors": {"angle": {"p95": 0.02}, "to_lane_centre": {"p95": 0.2}}}

    def posted(angle: float, centre: float | None) -> PostedFrame:
        answer = {"angle_rad": angle, "to_lane_centre_m": centre}
        return PostedFrame(b"", "r1", "oval", 2, NOTHING, 0.4, 0.01, "straight", 0.0, answer)

    good = check_posted([posted(0.02, 0.5), posted(0.0, None)], limits)
    assert [one.figure for one in good] == pytest.approx([0.01, 0.1])
    assert all(one.reached for one in good)
    bad = check_posted([posted(0.05, 0.7)], limits)
    assert [one.reached for one in bad] == [False, False]


def test_the_plan_scales_with_rounds_and_minutes(capsys: pytest.CaptureFixture[str]) -> None:
    announce(DemoConfig())
    announce(DemoConfig(rounds=600, minutes=30.0))
    announce(DemoConfig(first_drive=True))
    usual, longer, first = capsys.readouterr().err.split("the demo takes about ")[1:]
    assert usual.startswith("15 min on two cores:\n  1. first drive")
    assert "collect 300 rounds, 60000 frames (4 min)" in usual
    assert "collect 600 rounds, 120000 frames (8 min)" in longer
    assert "(31 min)" in longer
    assert usual.count("\n") == 7
    assert first.startswith("30 s on two cores")
    assert first.count("\n") == 2


@pytest.mark.slow
def test_the_first_drive_makes_a_film_of_the_shipped_models_answers(tmp_path: Path) -> None:
    done = typed("controllers", "demo", "--first-drive", "--out", tmp_path / "demo", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [len(result[name]) for name in ("shipped", "asked", "drive")] == [4, 0, 0]
    assert list(result["seconds"]) == ["first round", "first film"]
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    assert made == {"driverview-demo", "first", "first.csv", "first.log", "first.mp4"}
    film = cv2.VideoCapture(str(tmp_path / "demo" / "first.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 60


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UserError, match="holds other files"):
        run_demo(DemoConfig(out=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_run_module_returns_exit_code_and_output() -> None:
    assert run_module(["json.tool", "--help"])[0] == 0
    code, output = run_module(["json.tool", "no-such-file"])
    assert code != 0
    assert output == ""


def test_sigterm_also_ends_the_child_process(tmp_path: Path) -> None:
    """The child has time to clean up; this one writes a file."""
    (tmp_path / "child.py").write_text(
        "import pathlib, signal, sys, time\n"
        "def stop(*_):\n    pathlib.Path('stopped').touch()\n    sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, stop)\n"
        "pathlib.Path('started').touch()\n"
        "time.sleep(300)\n"
    )
    parent = (
        "from controllers.demo.process import run_module, stop_on_sigterm\n"
        "stop_on_sigterm()\nrun_module(['child'])\n"
    )
    root = Path(__file__).parents[3]
    with subprocess.Popen(
        [sys.executable, "-c", parent],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{root}"},
        stderr=subprocess.DEVNULL,
    ) as process:
        for _ in range(1200):
            if (tmp_path / "started").exists():
                break
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        process.wait(120)
    assert (tmp_path / "stopped").exists()


@pytest.mark.parametrize("minutes", [math.nan, math.inf])
def test_a_training_time_that_is_not_finite_is_refused(minutes: float) -> None:
    with pytest.raises(UserError, match=f"^--minutes is {minutes}; give a finite number"):
        DemoConfig(minutes=minutes)

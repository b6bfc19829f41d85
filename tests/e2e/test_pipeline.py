"""The whole pipeline at a small scale: one round, a few training steps, a service, a drive."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from controllers.demo.config import DemoConfig
from controllers.demo.frames import post_frames
from controllers.demo.process import running_service
from controllers.demo.report import write_report
from controllers.demo.run import DemoResult, write_soft_parameters
from datagen.recording import Dataset
from serve.client import Client
from trackfeatures import MARKINGS

pytestmark = pytest.mark.slow


def command(*arguments: str) -> Any:
    """Run one of the project's commands; its result with --json."""
    done = subprocess.run(
        [sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout) if "--json" in arguments else None


@pytest.mark.extended
def test_collect_train_evaluate_serve_and_drive(tmp_path: Path) -> None:
    data, run = str(tmp_path / "data"), str(tmp_path / "run")
    # 4 Hz and six sceneries: the drive below passes other places in another scenery, which must
    # not be out of distribution for the model.
    options = "--rounds 1 --frames 300 --tracks oval --lanes 1 --lights clear --frequency 4"
    options += " --stretch 20 --scenes 6 --seed 3 --workers 1"
    collected = command("datagen", "collect", *options.split(), "--out", data, "--json")
    assert (collected["rounds"], collected["frames"]) == (1, 300)
    verified = command("datagen", "verify", data, "--level", "deep", "--json")
    expected = {"ok": True, "rounds": 1, "frames": 300, "problems": []}
    assert {name: verified[name] for name in expected} == expected

    train = ("mtlnet", "train", "--data", data, "--out", run, "--alpha", "0.3,0.2,0.5")
    command(*train, "--recipe", "fast", "--iterations", "120")
    evaluated = command(
        "mtlnet", "evaluate", "--model", run, "--data", data, "--split", "all", "--json"
    )
    assert evaluated["frames"] == 300
    # On the frames it was trained on; a run gave 0.061 m, 0.0058 rad and 100 %.
    assert evaluated["errors"]["to_lane_centre"]["mean"] < 0.15
    assert evaluated["errors"]["angle"]["mean"] < 0.012
    assert evaluated["heading_accuracy"] > 0.95

    frames = Dataset.open(Path(data)).select("all")
    image = tmp_path / "frame.jpg"
    image.write_bytes(bytes(frames.jpeg(150)))
    predicted = command("mtlnet", "predict", "--model", run, str(image), "--json")
    with running_service(run, tmp_path / "serve.log") as url, Client(url) as client:
        answer = client.features(image.read_bytes())
        assert list(answer["distances_m"]) == list(MARKINGS)
        assert sum(answer["heading"].values()) == pytest.approx(1.0, abs=1e-3)
        assert answer["angle_rad"] == pytest.approx(predicted[0]["angle_rad"], abs=1e-6)
        posted = post_frames(frames, [100, 200], client)
        log = tmp_path / "drive.csv"
        words = f"controllers drive --controller lqr-preview --track oval --lanes 1 --log {log}"
        soft = write_soft_parameters(tmp_path / "soft.json")
        words += f" --perception {url} --steps 400 --parameters {soft} --json"
        drive = command(*words.split())
    # 400 steps of 50 ms: 20 s, on the oval's straight, which a model trained on 60 batches of that
    # road can follow; the first bend comes later.
    rows = log.read_text().splitlines()
    assert drive["ended"] is None
    assert drive["steps"] == len(rows) - 1 == 400
    assert drive["distance_m"] > 100
    assert drive["slowed_steps"] == 0
    assert drive["mean_abs_d_m"] < 0.3
    assert drive["max_abs_d_m"] < 0.8
    steering = {row.split(",")[8] for row in rows[1:]}
    assert len(steering) > 100, "steering must vary with the answers"

    result = DemoResult(collected, evaluated, drive, posted, ["datagen collect"], {"collect": 1.0})
    page = write_report(DemoConfig(out=tmp_path), result).read_text()
    assert page.count("data:image/jpeg;base64,") == 2
    assert f"{evaluated['angle_mae_rad']:.4f}" in page

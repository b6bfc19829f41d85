"""Rounds driven on a model's answers: the dataset, its resumption, and the steering law."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from controllers.interface import LoopConfig
from controllers.perception.perceived import Perceived
from controllers.record.cli import RecordConfig, _plan
from controllers.record.law import MakePerceivedLaw, PerceivedLaw
from datagen.execution.collect import initialise_folder, require_matching_folder
from datagen.execution.merge import merge
from datagen.execution.progress import CollectResult
from datagen.recorder.replay import replay
from datagen.recording import Dataset, Labels
from datagen.recording.errors import DatasetError
from datagen.recording.integrity.verify import verify
from mtlnet.data.rounds import open_training_dataset
from mtlnet.inference.model_card import resolve_run
from mtlnet.training.sources import recorded_training_data
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from tests.datagen.commands import recording_here
from tests.typed import typed
from trackfeatures import RoadClass, UserError

SHORT = ["--rounds", "2", "--frames", "60", "--tracks", "oval", "--lanes", "1", "--workers", "1"]
COMMAND = [sys.executable, "-m", "controllers", "record", *SHORT, "--lights", "clear", "--json"]


LAW = "class Law:\n    def update(self, observation):\n        return 0.0\n"


def record(out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """Run the command in this process."""
    return typed(*COMMAND[2:], "--out", out, *more)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rounds; the command is killed after the first and run again."""
    out = tmp_path_factory.mktemp("record") / "driven"
    with subprocess.Popen(
        [*COMMAND, "--out", str(out)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as process:
        deadline = time.monotonic() + 500
        while not list(out.glob("state/*.json")):
            assert process.poll() is None, process.stderr and process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
    assert len(list(out.glob("state/*.json"))) == 1
    with recording_here():
        done = record(out)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["recorded_frames"] == 60
    return out


def test_a_recording_is_an_ordinary_dataset(recorded: Path) -> None:
    report = verify(recorded, "deep")
    assert report.ok, report.problems
    assert [info.id for info in Dataset.open(recorded).rounds] == [
        "driven-1000-000",
        "driven-1000-001",
    ]
    assert "In 2 of 2 rounds (`driven-...`" in (recorded / "README.md").read_text()
    data = recorded_training_data(open_training_dataset(recorded))
    assert len(data.frames) == 60
    labels = data.frames.labels
    assert isinstance(labels, Labels)
    assert labels.speed.min() > 5.0
    assert 0.2 < abs(labels.to_middle).max() < 4.5  # the course sways about a lane of 4 m


def test_the_plan_names_the_driver_and_another_one_is_refused(recorded: Path) -> None:
    driver = json.loads((recorded / "plan.json").read_text())["driver"]
    assert driver["controller"] == "lqr"
    assert len(driver["model"]) == 64
    refused = record(recorded, "--controller", "lqr-preview")
    assert refused.returncode != 0
    assert "driver: controller lqr, " in refused.stderr.replace("\n", " ")
    with pytest.raises(DatasetError, match="not by the scripted driver"):
        replay(recorded, 1)


def test_another_law_in_the_file_of_a_controller_is_refused(tmp_path: Path) -> None:
    law, out = tmp_path / "law.py", tmp_path / "out"
    law.write_text(LAW)
    options = RecordConfig(f"{law}:Law", str(resolve_run("default")), rounds=1, tracks="oval")
    begun, _ = _plan(options)
    out.mkdir()
    initialise_folder(out, begun)
    law.write_text(LAW.replace("0.0", "0.1"))
    changed, _ = _plan(options)
    with pytest.raises(DatasetError, match=r"driver: controller .*:Law, model .*, files .* in its"):
        require_matching_folder(out, changed)
    earlier = {name: value for name, value in begun.driver.items() if name != "files"}
    initialise_folder(out, replace(begun, driver=earlier))
    require_matching_folder(out, changed)  # a plan of an earlier version has no hash of the files
    with pytest.raises(DatasetError, match="driver: controller"):
        require_matching_folder(out, replace(changed, driver={**changed.driver, "model": "other"}))
    with pytest.raises(DatasetError, match=r"driver: controller .* now the scripted one"):
        require_matching_folder(out, replace(changed, driver={}))


def test_the_workers_load_the_model_that_is_latest_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "runs" / "one"
    shutil.copytree(resolve_run("default"), model)
    (tmp_path / "runs" / "latest").symlink_to("one")
    laws: list[MakePerceivedLaw] = []

    def recorded_plan(*arguments: Any) -> CollectResult:
        laws.append(arguments[-1])
        raise UserError("nothing is recorded")

    monkeypatch.setattr("controllers.record.cli.record_plan", recorded_plan)
    options = ("--rounds", "1", "--tracks", "oval", "--model", "latest")
    typed("controllers", "record", *options, folder=tmp_path)
    assert laws == [MakePerceivedLaw("lqr", str(model))]


@pytest.mark.extended
def test_recordings_are_merged_with_rounds_of_another_plan(recorded: Path, tmp_path: Path) -> None:
    other = tmp_path / "collected"
    done = subprocess.run(
        [sys.executable, "-m", "datagen", "collect", *SHORT, "--out", str(other)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    merged = merge([other, recorded], tmp_path / "both")
    assert (merged.rounds, merged.planned, merged.frames) == (4, 4, 240)
    assert verify(tmp_path / "both", "full").ok
    assert "In 2 of 4 rounds" in (tmp_path / "both" / "README.md").read_text()
    splits = {info.id: info.split for info in Dataset.open(tmp_path / "both").rounds}
    assert splits.keys() == {"round-000", "round-001", "driven-1000-000", "driven-1000-001"}
    assert merge([recorded, other], tmp_path / "both").added == 0
    with pytest.raises(DatasetError, match="not by the scripted driver"):
        replay(tmp_path / "both", 1)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--controller", "nobody"], "there is no controller 'nobody'"),
        (["--model", "/no/such/run"], "there is no run /no/such/run"),
        (["--split", "unseen"], "track oval is one of those to train on"),
    ],
)
def test_impossible_options_are_refused(tmp_path: Path, args: list[str], message: str) -> None:
    done = record(tmp_path / "out", *args)
    assert done.returncode != 0
    assert message in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def law_on(lanes: int, answer: Perceived, to_middle: float) -> Callable[[float], float]:
    """The steering towards an offset, of a car at `to_middle` that perceives `answer`."""
    road = Road(find_track("oval", None), lanes)
    with World(road, traffic=0, frequency_hz=20) as world:
        state = world.reset(seed=0, to_middle=to_middle, speed=15.0)
        law = PerceivedLaw("lqr", LoopConfig(0.05, noisy=True), lambda world: answer, world)
        return lambda offset: law.steer(state, offset, 0.0)


def test_the_answered_offset_is_that_of_the_lane_the_car_is_in() -> None:
    """Two lanes of 4 m: 0.1 m right of the left lane's centre is 1.9 m left of the middle."""
    steer = law_on(2, Perceived(-0.1, 0.0, RoadClass.STRAIGHT), 1.7)
    assert steer(1.9) == pytest.approx(0.0, abs=1e-9)
    assert steer(2.4) > 0.05
    assert steer(1.4) < -0.05
    # Near the middle marking the model answers for the adjacent lane.
    steer = law_on(2, Perceived(2.1, 0.0, RoadClass.STRAIGHT), 0.05)
    assert steer(0.1) == pytest.approx(0.0, abs=1e-9)


def test_the_truth_does_not_correct_a_wrong_answer() -> None:
    steer = law_on(1, Perceived(0.5, 0.0, RoadClass.STRAIGHT), 0.0)
    assert steer(0.0) < -0.05
    assert steer(0.5) == pytest.approx(0.0, abs=1e-9)

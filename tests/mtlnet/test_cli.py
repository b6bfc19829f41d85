"""The `mtlnet` command: its output, and one clear line for each mistake of the user."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from typer.main import get_command
from typer.testing import CliRunner

from datagen.recording.splits import Split, split_path, write_split
from mtlnet import cli as mtlnet_cli
from mtlnet.inference.curves import read_curves
from tests.typed import error_line, typed


def mtlnet(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return typed("mtlnet", *arguments, folder=folder)


def refused(*arguments: object, folder: Path | None = None) -> str:
    done = mtlnet(*arguments, folder=folder)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    return last


def test_the_service_needs_no_torch(published: Path) -> None:
    code = (
        "import sys, numpy as np; from pathlib import Path;"
        "from mtlnet.inference.engine import load_engine;"
        "from mtlnet.inference.prediction import decode_outputs;"
        f"e = load_engine(Path({str(published)!r})); "
        "decode_outputs(e(np.zeros((210, 280, 3), np.uint8)));"
        "print([m for m in ('torch', 'mcap', 'safetensors') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.usefixtures("small_network")
def test_train_evaluate_and_predict(dataset: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    base = ["train", "--data", dataset, "--out", run, "--batch", 4, "--iterations", 2]
    trained = mtlnet(*base, "--alpha", "0.3,0.2,0.5", "--json")
    assert trained.returncode == 0, trained.stderr
    assert json.loads(trained.stdout)["iterations"] == 2

    evaluated = mtlnet("evaluate", "--model", run, "--data", dataset, "--split", "test", "--json")
    report = json.loads(evaluated.stdout)
    assert report["frames"] == 24
    assert set(report["mae_m"]) == {"ml", "mr", "l", "m", "r"}
    assert 0 < report["mae_m"]["ml"] < 5
    assert report["by_lanes"]["1"]["mae_m"] == report["mae_m"]
    assert report["baseline"]["angle_mae_rad"] == pytest.approx(0.04, abs=0.02)
    table = mtlnet("evaluate", "--model", run, "--data", dataset, "--every", "5")
    assert "on 5 test frames" in table.stdout
    assert "to lane centre (m)" in table.stdout

    unseen = shutil.copytree(dataset, tmp_path / "unseen")
    write_split(split_path(unseen), Split(train=(), test=(), unseen=("r003",)))
    known = refused("evaluate", "--model", run, "--data", unseen, "--split", "unseen")
    assert "was trained on track alpha, which is not unseen to it" in known
    card = json.loads((run / "card.json").read_text())
    card["data"]["tracks"] = ["beta"]
    (run / "card.json").write_text(json.dumps(card))
    judged = mtlnet("evaluate", "--model", run, "--data", unseen, "--split", "unseen", "--json")
    assert json.loads(judged.stdout)["frames"] == 24

    image = tmp_path / "frame.jpg"
    pixels = np.full((420, 560, 3), 90, np.uint8)  # twice the size: scaled down
    image.write_bytes(simplejpeg.encode_jpeg(pixels))
    answers = json.loads(mtlnet("predict", "--model", run, image, image, "--json").stdout)
    assert len(answers) == 2
    assert set(answers[0]) >= {"distances_m", "to_lane_centre_m", "angle_rad", "heading", "model"}
    assert sum(answers[0]["heading"].values()) == pytest.approx(1, abs=1e-5)

    again = refused(*base)
    assert f"{run} already exists" in again


def test_images_beside_one_that_cannot_be_used_are_answered(
    published: Path, tmp_path: Path
) -> None:
    good, bad, table = (tmp_path / name for name in ("good.jpg", "bad.jpg", "all.csv"))
    good.write_bytes(simplejpeg.encode_jpeg(np.full((210, 280, 3), 90, np.uint8)))
    bad.write_text("not an image at all")
    given = ("predict", "--model", published, bad, good, tmp_path / "none.mp4")
    done = mtlnet(*given, "--json", "--out", table)
    assert done.returncode == 1
    line = error_line(done)
    assert "bad.jpg: no image file" in line
    assert line.endswith("(and 1 more); 1 image done")
    (row,) = json.loads(done.stdout)
    assert row["image"] == str(good)
    assert [line.partition(",")[0] for line in table.read_text().splitlines()] == [
        "image",
        str(good),
    ]
    assert "heading" in mtlnet(*given).stdout  # of the table


def test_wrong_options_of_training_are_refused(dataset: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    train = ["train", "--data", dataset, "--out", new]
    assert "weight for angle is -1" in refused(*train, "--alpha", "0.3,-1,0.5")
    assert "has 2 weight(s)" in refused(*train, "--alpha", "0.3,0.2")
    assert "is not a training run" in refused(*train, "--resume")
    assert "no recorded rounds" in refused("train", "--data", tmp_path / "no", "--out", new)
    assert not new.exists()
    assert "no runs/latest" in refused(
        "evaluate", "--model", "latest", "--data", dataset, folder=tmp_path
    )


@pytest.mark.extended
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_a_checkpoint_to_resume_from(
    dataset: Path, tmp_path: Path, number: signal.Signals
) -> None:
    run = tmp_path / "run"
    command = ["train", "--data", dataset, "--out", run, "--batch", 2, "--iterations", 2000]
    process = subprocess.Popen(
        [sys.executable, "-m", "mtlnet", *map(str, command)], stderr=subprocess.PIPE, text=True
    )
    limit = time.monotonic() + 300
    while not read_curves(run / "curves.csv") and time.monotonic() < limit:
        time.sleep(0.2)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr
    assert "--resume" in stderr
    (checkpoint,) = (run / "checkpoints").iterdir()
    step = int(checkpoint.stem.removeprefix("step-"))
    assert step >= 10
    done = mtlnet("train", "--out", run, "--resume", "--iterations", step + 1, "--json")
    assert json.loads(done.stdout)["iterations"] == step + 1, done.stderr


def test_help_shows_the_default_of_every_option_with_a_value() -> None:
    app = mtlnet_cli.app
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]  # a group's
        options = [p for p in command.params if p.param_type_name == "option" and not p.is_flag]
        shown = CliRunner().invoke(app, [name, "--help"]).output
        assert shown.count("[default: ") == sum(not option.required for option in options), name

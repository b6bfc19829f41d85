"""Runs the steps of the demo. Each step is a command of this project; the command is printed before
it runs."""

import json
import shlex
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from controllers.demo.config import DemoConfig
from controllers.demo.frames import PostedFrame, post_frames, spread
from controllers.demo.process import run_module, running_service
from controllers.laws.lqr import WEIGHTS_BRIEFLY_TRAINED
from datagen.recording import Dataset
from runtime.files import write_json
from serve.client import Client
from trackfeatures import UserError

LOG = Console(stderr=True, highlight=False, markup=False)
FIRST_TRACK = "coast"
"""Track of the first drive; no model is trained on it."""
FIRST_FRAMES, FIRST_POSTED = 60, 4
"""Number of frames of the first drive, and number of these frames that are posted to the
service."""
TEST_SHARE = 0.1
"""Share of the collected rounds that is held out for testing."""
DRIVE_STEPS = 800
"""Control steps of 50 ms of the drive: 40 s from a standing start."""
COLLECTED_PER_S, CHECKED_PER_S = 250, 2_000
"""Frames that two cores collect in a second, and frames that they verify in a second. The plan that
`announce` prints is computed from these speeds."""


@dataclass(slots=True)
class DemoResult:
    """The results of all steps of the demo, for its report."""

    collected: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, Any] = field(default_factory=dict)
    drive: dict[str, Any] = field(default_factory=dict)
    asked: list[PostedFrame] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    shipped: list[PostedFrame] = field(default_factory=list)
    """Frames of the first drive with the answers of the shipped model."""

    def as_json(self) -> dict[str, Any]:
        """Return the fields as values for JSON, without the images."""
        content = asdict(self)
        for one in content["asked"] + content["shipped"]:
            del one["jpeg"]
        return content


def announce(config: DemoConfig) -> None:
    """Print the parts of the demo, and the approximate duration of each part on two cores."""
    frames = config.rounds * config.frames
    parts = [
        (0.5, f"first drive: a film of the shipped model's answers, {config.out / 'first.mp4'}"),
        (frames / COLLECTED_PER_S / 60, f"collect {config.rounds} rounds, {frames} frames"),
        (frames / CHECKED_PER_S / 60, "verify them"),
        (config.minutes + 0.7, "train a network on them, and fit its standard deviations"),
        (0.4, "evaluate it on the test rounds"),
        (0.7, f"serve it, ask it, drive a car on its answers, {config.out / 'report.html'}"),
    ]
    if config.first_drive:
        parts = parts[:1]
    whole = _duration(sum(part[0] for part in parts))
    LOG.print(f"the demo takes about {whole} on two cores:")
    for number, (minutes, what) in enumerate(parts, start=1):
        LOG.print(f"  {number}. {what} ({_duration(minutes)})", markup=False, soft_wrap=True)


def _duration(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes >= 1.5 else f"{max(round(6 * minutes), 1) * 10} s"


def run_demo(config: DemoConfig) -> DemoResult:
    """Try the shipped model, then collect, verify, train, evaluate, serve, predict and drive.

    All results are written to `config.out`. With `config.first_drive` the demo ends after the drive
    of the shipped model. Raises UserError if `config.out` contains files that no demo has written,
    or if a step fails.
    """
    _check_folder(config.out)
    result = DemoResult()
    data, run = str(config.out / "data"), str(config.out / "run")
    collect = ["datagen", "collect", "--out", data, "--json"]
    collect += ["--rounds", str(config.rounds), "--frames", str(config.frames)]
    # A short training needs frames that are far apart in time and whose sceneries differ from frame
    # to frame (docs/experiments/data.md). By default a round of this length has one scenery.
    collect += ["--frequency", "4", "--stretch", "1", "--scenes", "4"]
    collect += ["--split-test-share", f"{TEST_SHARE:g}"]
    collect += ["--tracks", config.tracks, "--seed", str(config.seed)]
    train = ["mtlnet", "train", "--data", data, "--out", run, "--alpha", config.alpha]
    train += ["--recipe", "fast", "--minutes", f"{config.minutes:g}", "--seed", str(config.seed)]
    if (config.out / "run" / "config.json").exists():
        train.append("--resume")
    evaluate = ["mtlnet", "evaluate", "--model", run, "--data", data, "--split", "test", "--json"]

    _try_shipped_model(config, result)
    if config.first_drive:
        return result
    result.collected = json.loads(_step(result, "collect", collect))
    _step(result, "verify", ["datagen", "verify", data, "--level", "full"])
    _step(result, "train", train)
    result.evaluation = json.loads(_step(result, "evaluate", evaluate))
    _use_service(config, result)
    write_json(config.out / "result.json", result.as_json())
    return result


def _try_shipped_model(config: DemoConfig, result: DemoResult) -> None:
    """Serve the shipped model, post frames of a short round, and draw its answers in a film."""
    folder = config.out / "first"
    collect = ["datagen", "collect", "--out", str(folder), "--json", "--split", "unseen"]
    collect += ["--rounds", "1", "--frames", str(FIRST_FRAMES), "--frequency", "5"]
    collect += ["--tracks", FIRST_TRACK, "--lanes", "2", "--lights", "clear"]
    _step(result, "first round", [*collect, "--seed", str(config.seed)])
    frames = Dataset.open(folder).select("unseen")
    _log_command(result, "serve")
    with running_service("default", config.out / "first.log") as url, Client(url) as client:
        chosen = spread(frames, FIRST_POSTED, np.random.default_rng([config.seed, 2]))
        result.shipped = post_frames(frames, chosen, client)
    film = ["--out", str(config.out / "first.mp4"), "--out", str(config.out / "first.csv")]
    _step(result, "first film", ["mtlnet", "predict", str(frames.rounds[0].path), *film])
    LOG.print(f"the shipped model's answers are drawn in {config.out / 'first.mp4'}")


def _use_service(config: DemoConfig, result: DemoResult) -> None:
    """Post held-out frames to a service, and drive a car on its answers."""
    started = time.monotonic()
    _log_command(result, f"serve --model {config.out / 'run'}")
    frames = Dataset.open(config.out / "data").select("test")
    chosen = spread(frames, config.asked, np.random.default_rng([config.seed, 1]))
    with (
        running_service(str(config.out / "run"), config.out / "serve.log") as url,
        Client(url) as client,
    ):
        result.asked = post_frames(frames, chosen, client)
        result.seconds["serve"] = time.monotonic() - started
        drive = ["controllers", "drive", "--controller", "lqr-preview"]
        drive += ["--track", config.drive_track]
        drive += ["--lanes", "1", "--perception", url, "--steps", str(DRIVE_STEPS), "--json"]
        drive += ["--log", str(config.out / "drive.csv")]
        drive += ["--parameters", str(write_soft_parameters(config.out / "soft-weights.json"))]
        result.drive = json.loads(_step(result, "drive", drive))


def write_soft_parameters(path: Path) -> Path:
    """Write a parameter file for `controllers drive --parameters` to `path`; return `path`.

    The file contains weights of the controller `lqr-preview` that lead to low gains, because the
    answers of a model that was trained for minutes have large errors.
    """
    parameters = asdict(WEIGHTS_BRIEFLY_TRAINED)
    write_json(path, {"controllers": {"lqr-preview": {"parameters": parameters}}})
    return path


def _step(result: DemoResult, name: str, command: list[str]) -> str:
    """Run a command of the project; returns its stdout. Its stderr is not captured."""
    shown = shlex.join(command)
    _log_command(result, shown)
    started = time.monotonic()
    code, output = run_module(command)
    result.seconds[name] = time.monotonic() - started
    if code:
        sys.stderr.write(output)
        raise UserError(f"`{shown}` ended with exit code {code}; its message is above")
    return output


def _log_command(result: DemoResult, command: str) -> None:
    result.commands.append(command)
    LOG.print(f"$ {command}", style="bold")


def _check_folder(out: Path) -> None:
    marker = out / "driverview-demo"
    if out.exists() and any(out.iterdir()) and not marker.exists():
        raise UserError(f"{out} holds other files; give an empty or new folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    marker.touch()

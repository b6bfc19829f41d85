"""The steps of the demo. Each is the command that a user would type, printed before it runs."""

import json
import shlex
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from controllers.demo.frames import Asked, ask, spread
from controllers.demo.process import run_module, running_service
from datagen.recording import Dataset
from serve.client import Client
from trackfeatures import UserError

LOG = Console(stderr=True, highlight=False)
DRIVE_STEPS = 800
"""of 50 ms: 40 s from a standing start"""


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What the demo collects and how long it learns; the defaults fit 15 minutes on two cores."""

    out: Path
    tracks: str = "circuit,countryside,forest,highway,mountain-pass"
    rounds: int = 100
    frames: int = 200
    seed: int = 1
    minutes: float = 8.5
    """of training"""
    alpha: str = "0.3,0.2,0.5"
    asked: int = 12
    """held-out frames that are posted to the service"""
    drive_track: str = "highway"


@dataclass(slots=True)
class DemoResult:
    """What every step said, for the report."""

    collected: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, Any] = field(default_factory=dict)
    drive: dict[str, Any] = field(default_factory=dict)
    asked: list[Asked] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """All of it but the pictures."""
        content = asdict(self)
        for one in content["asked"]:
            del one["jpeg"]
        return content


def run_demo(config: DemoConfig) -> DemoResult:
    """Collect, verify, train, evaluate, serve, ask, drive; `config.out` holds all that comes of it.

    Raises UserError when `config.out` holds something else than an earlier demo, or a step fails.
    """
    _check_folder(config.out)
    result = DemoResult()
    data, run = str(config.out / "data"), str(config.out / "run")
    collect = ["datagen", "collect", "--out", data, "--json"]
    collect += ["--rounds", str(config.rounds), "--frames", str(config.frames)]
    collect += ["--scenes", "4"]  # rounds so short would show one each
    collect += ["--tracks", config.tracks, "--seed", str(config.seed)]
    train = ["mtlnet", "train", "--data", data, "--out", run, "--alpha", config.alpha]
    train += ["--recipe", "fast", "--minutes", f"{config.minutes:g}", "--seed", str(config.seed)]
    if (config.out / "run" / "config.json").exists():
        train.append("--resume")
    evaluate = ["mtlnet", "evaluate", "--model", run, "--data", data, "--split", "test", "--json"]

    result.collected = json.loads(_step(result, "collect", collect))
    _step(result, "verify", ["datagen", "verify", data, "--level", "full"])
    _step(result, "train", train)
    result.evaluation = json.loads(_step(result, "evaluate", evaluate))
    _use_service(config, result)
    text = json.dumps(result.as_json(), indent=1)
    (config.out / "result.json").write_text(text + "\n")
    return result


def _use_service(config: DemoConfig, result: DemoResult) -> None:
    """Post held-out frames and let the answers steer a car, on one service."""
    started = time.monotonic()
    _show(result, f"serve --model {config.out / 'run'}")
    frames = Dataset.open(config.out / "data").select("test")
    chosen = spread(frames, config.asked, np.random.default_rng([config.seed, 1]))
    with (
        running_service(config.out / "run", config.out / "serve.log") as url,
        Client(url) as client,
    ):
        result.asked = ask(frames, chosen, client)
        result.seconds["serve"] = time.monotonic() - started
        drive = ["controllers", "drive", "--controller", "lqr", "--track", config.drive_track]
        drive += ["--lanes", "1", "--perception", url, "--steps", str(DRIVE_STEPS), "--json"]
        drive += ["--log", str(config.out / "drive.csv")]
        result.drive = json.loads(_step(result, "drive", drive))


def _step(result: DemoResult, name: str, command: list[str]) -> str:
    """Run one of the project's commands; its standard output comes back, the rest is shown."""
    shown = shlex.join(command)
    _show(result, shown)
    started = time.monotonic()
    code, said = run_module(command)
    result.seconds[name] = time.monotonic() - started
    if code:
        sys.stderr.write(said)
        raise UserError(f"`{shown}` ended with exit code {code}; its message is above")
    return said


def _show(result: DemoResult, command: str) -> None:
    result.commands.append(command)
    LOG.print(f"$ {command}", style="bold", markup=False)


def _check_folder(out: Path) -> None:
    marker = out / "driverview-demo"
    if out.exists() and any(out.iterdir()) and not marker.exists():
        raise UserError(f"{out} holds other files; name an empty or new folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    marker.touch()

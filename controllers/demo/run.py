"""The steps of the demo. Each is the command that a user would type, printed before it runs."""

import json
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from controllers.demo.frames import Asked, ask, spread
from controllers.demo.service import running_service
from datagen.recording import Dataset
from serve.client import Client
from trackfeatures import UserError

LOG = Console(stderr=True, highlight=False)


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What the demo collects and how long it learns; the defaults fit 15 minutes on two cores."""

    out: Path
    tracks: str = "circuit,countryside,forest,highway,mountain-pass"
    rounds: int = 40
    frames: int = 500
    seed: int = 1
    minutes: float = 9.5
    """of training"""
    alpha: str = "0.3,0.2,0.5"
    asked: int = 12
    """held-out frames that are posted to the service"""


@dataclass(slots=True)
class DemoResult:
    """What every step said, for the report."""

    collected: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, Any] = field(default_factory=dict)
    drive: dict[str, Any] = field(default_factory=dict)
    asked: list[Asked] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")


def run_demo(config: DemoConfig) -> DemoResult:
    """Collect, verify, train, evaluate, serve, ask, drive; `config.out` holds all that comes of it.

    Raises UserError when `config.out` holds something else than an earlier demo, or a step fails.
    """
    _check_folder(config.out)
    result = DemoResult()
    data, run = str(config.out / "data"), str(config.out / "run")
    collect = ["datagen", "collect", "--out", data, "--json"]
    collect += ["--rounds", str(config.rounds), "--frames", str(config.frames)]
    collect += ["--tracks", config.tracks, "--seed", str(config.seed)]
    train = ["mtlnet", "train", "--data", data, "--out", run, "--alpha", config.alpha]
    train += ["--recipe", "fast", "--minutes", f"{config.minutes:g}", "--seed", str(config.seed)]
    if (config.out / "run").exists():
        train.append("--resume")
    evaluate = ["mtlnet", "evaluate", "--model", run, "--data", data, "--split", "test", "--json"]

    result.collected = json.loads(_step(result, "collect", collect))
    _step(result, "verify", ["datagen", "verify", data, "--level", "full"])
    _step(result, "train", train)
    result.evaluation = json.loads(_step(result, "evaluate", evaluate))
    _use_service(config, result)
    result.write(config.out / "result.json")
    return result


def _use_service(config: DemoConfig, result: DemoResult) -> None:
    """Post held-out frames and let the answers steer a car, on one service."""
    started = time.monotonic()
    result.commands.append(f"serve --model {config.out / 'run'}")
    LOG.print(f"[bold]$ {result.commands[-1]}[/bold]")
    frames = Dataset.open(config.out / "data").select("test")
    chosen = spread(frames, config.asked, np.random.default_rng([config.seed, 1]))
    with (
        running_service(config.out / "run", config.out / "serve.log") as url,
        Client(url) as client,
    ):
        result.asked = ask(frames, chosen, client)
        result.seconds["serve"] = time.monotonic() - started
        track = result.asked[0].track
        drive = ["controllers", "drive", "--controller", "lqr", "--track", track, "--lanes", "1"]
        drive += ["--perception", url, "--steps", "400", "--json"]
        drive += ["--log", str(config.out / "drive.csv")]
        result.drive = json.loads(_step(result, "drive", drive))


def _step(result: DemoResult, name: str, command: list[str]) -> str:
    """Run one of the project's commands; its standard output comes back, the rest is shown."""
    shown = shlex.join(command)
    result.commands.append(shown)
    LOG.print(f"[bold]$ {shown}[/bold]")
    started = time.monotonic()
    # The same interpreter's modules, whatever else the PATH holds.
    done = subprocess.run([sys.executable, "-m", *command], stdout=subprocess.PIPE, text=True)
    result.seconds[name] = time.monotonic() - started
    if done.returncode:
        sys.stderr.write(done.stdout)
        raise UserError(f"`{shown}` ended with exit code {done.returncode}; its message is above")
    return done.stdout


def _check_folder(out: Path) -> None:
    marker = out / "driverview-demo"
    if out.exists() and any(out.iterdir()) and not marker.exists():
        raise UserError(f"{out} holds other files; name an empty or new folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    marker.touch()

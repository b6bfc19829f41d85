"""A search for the parameters of several controllers, with the same number of drives for each.

The first candidate is the controller's own parameters. The candidates of the first third of the
budget are log-uniformly random over the whole ranges. All later candidates are random around the
best random candidate so far, at distances that shrink in proportion to the remaining budget. The
result is the best of all candidates. The file `config.out` is written after each candidate, so the
same command continues an interrupted search.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from controllers.compare.cells import names
from controllers.compare.config import TuneConfig
from controllers.drive.closed_loop import check_reward
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import find_disturbance
from controllers.drive.many import drive_many
from controllers.drive.run import GRID_SHARE
from controllers.registry import CONTROLLERS
from runtime.files import check_folder, locked_file, write_json
from simulator.track.catalogue import find_track
from trackfeatures.errors import UserError

VERSION = 1
EXPLORED = 1.0 / 3.0
"""Share of the candidates that are random over the whole ranges."""
SETTINGS = ("tracks", "reward", "steps", "disturbance", "seed", "budget")
"""Settings that are stored in the file of a search, together with the hash of each road. A search
with other settings or roads refuses this file."""

Progress = Callable[[int, int, str], None]
"""A function that is called with the number of candidates done, the total number of candidates, and
the name of the controller."""


def tune(config: TuneConfig, progress: Progress | None = None) -> dict[str, Any]:
    """Search for the best parameters of each controller; return the content of the file
    `config.out`.

    The content is {"version", "settings", "controllers"}. For each controller it has the parameters
    and the reward per step of the best candidate, and all candidates that were tried. Raises
    UserError for an unknown name, for a file of a search with other settings or roads, or for a
    file that another process is writing.
    """
    controllers = names(config.controllers, "controllers")
    for controller in controllers:
        if controller not in CONTROLLERS or not CONTROLLERS[controller].tunable:
            able = ", ".join(name for name, entry in CONTROLLERS.items() if entry.tunable)
            raise UserError(f"{controller!r} cannot be tuned; use some of: {able}")
    check_reward(config.reward)
    if config.budget < 1:
        raise UserError(f"a budget of {config.budget} drives; give 1 or more")
    find_disturbance(config.disturbance)
    for track in names(config.tracks, "tracks"):
        find_track(track, config.tracks_dir)
    check_folder(config.out)
    with locked_file(config.out):
        return _search(config, controllers, progress)


def _search(
    config: TuneConfig, controllers: list[str], progress: Progress | None
) -> dict[str, Any]:
    content = _read(config.out, config)
    total = config.budget * len(controllers)
    for number, controller in enumerate(controllers):
        ranges = CONTROLLERS[controller].tunable
        tried = content["controllers"].get(controller, {}).get("tried", [])
        while len(tried) < config.budget:
            if progress is not None:
                progress(number * config.budget + len(tried), total, controller)
            rng = np.random.default_rng([config.seed, len(tried)])
            parameters = propose(ranges, tried, config.budget, rng)
            tried.append(
                {"parameters": parameters, "reward": evaluate(config, controller, parameters)}
            )
            best = max(tried, key=lambda one: float(one["reward"]))
            content["controllers"][controller] = {
                "parameters": best["parameters"],
                "reward": best["reward"],
                "untuned": tried[0]["reward"],
                "tried": tried,
            }
            write_json(config.out, content)
    return content


def propose(
    ranges: Mapping[str, tuple[float, float]],
    tried: list[dict[str, Any]],
    budget: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return the next candidate, parameters by name; {} stands for the controller's own parameters.

    `ranges` has the least and the greatest value of each parameter. `tried` has the candidates so
    far, {"parameters", "reward"}. `budget` is the number of all candidates.
    """
    if not tried:
        return {}
    drawn = tried[1:]  # the first candidate, {}, has no values
    if len(tried) <= EXPLORED * budget or not drawn:
        return {
            name: math.exp(rng.uniform(math.log(low), math.log(high)))
            for name, (low, high) in ranges.items()
        }
    best = max(drawn, key=lambda one: float(one["reward"]))["parameters"]
    left = 1.0 - len(tried) / budget
    found = {}
    for name, (low, high) in ranges.items():
        step = 0.3 * left * math.log(high / low) * rng.normal()
        found[name] = min(max(best[name] * math.exp(step), low), high)
    return found


def evaluate(config: TuneConfig, controller: str, parameters: Mapping[str, float]) -> float:
    """Drive `controller` with `parameters` on the tracks of `config`; returns the mean reward per
    step."""
    tasks = []
    for name in names(config.tracks, "tracks"):
        drive = DriveConfig(
            controller=controller,
            track=name,
            steps=config.steps,
            start_d=-GRID_SHARE * find_track(name, config.tracks_dir).width,
            seed=config.seed,
            tracks_dir=config.tracks_dir,
        )
        tasks.append((drive, find_disturbance(config.disturbance)))
    rewards = [0.0] * len(tasks)
    for outcomes in drive_many(tasks, parameters):
        for outcome in outcomes:
            if isinstance(outcome.result, UserError):
                raise outcome.result
            rewards[outcome.number] = outcome.result.per_step(config.reward)
    return float(np.mean(rewards))


def _read(path: Path, config: TuneConfig) -> dict[str, Any]:
    settings: dict[str, Any] = {name: getattr(config, name) for name in SETTINGS}
    settings["roads"] = [
        find_track(name, config.tracks_dir).driving_hash for name in names(config.tracks, "tracks")
    ]
    if not path.exists():
        return {"version": VERSION, "settings": settings, "controllers": {}}
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        found, version = content["settings"], content["version"]
        _ = content["controllers"].items()
    except (AttributeError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} holds no tuning ({error!r}); give another --out") from error
    if version != VERSION or found != settings:
        raise UserError(f"{path} was made with other settings, {found}; give another --out")
    return content

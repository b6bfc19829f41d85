"""The drives of a comparison, and the file with their results.

Drives with exact states (perception `truth`) are made in batches if their controller has
`update_batch`; all other drives are made one by one. `results.json` is {"version", "settings",
"drives": [...]} and is written after each batch or single drive. A drive whose result is in the
file is made again only if its controller, tuned parameters, road or model has changed.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from controllers.compare.cells import Cell, cells
from controllers.compare.config import CompareConfig
from controllers.compare.curves import CurveRecorder, curves_of
from controllers.compare.inputs import (
    fingerprints,
    parameters_of,
    require_parameters,
    with_resolved_model,
)
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES
from controllers.drive.many import Outcome, Task, can_join, drive_many
from controllers.drive.run import GRID_SHARE, drive
from controllers.interface import LoopConfig
from controllers.perception.sources import check_perception
from controllers.registry import make_controller
from runtime.files import locked_folder, write_json
from simulator.camera import check_light
from simulator.track.catalogue import find_track
from simulator.world.errors import ContactsUnavailable
from trackfeatures.errors import UserError

VERSION = 3
"""Version of `results.json`."""
RESULTS, REPORT = "results.json", "report.html"
SETTINGS = ("steps", "start_d", "latency_ms", "drop", "model", "views", "light")
"""Names of the options of a comparison that are equal for all drives in a `results.json`."""

Progress = Callable[[float, int, str], None]
"""A function that is called, by several threads, with the number of drives done (parts count as
fractions), the total number of drives, and the name of the present drive or controller."""
Report = Callable[[float, str], None]
"""A function that is called with the number of drives done (parts count as fractions) and the name
of the present drive or controller."""
Driven = dict[str, Any] | UserError
"""The result of a drive with its curves, or the error of a drive without a result."""


def compare(config: CompareConfig, progress: Progress | None = None) -> dict[str, Any]:
    """Make the drives whose results are missing in `config.out`; return the content of
    `results.json`, with only the drives of this comparison.

    Raises UserError before the first drive for an unknown name, a `results.json` with other
    settings, or a folder to which another process writes. Raises ContactsUnavailable after the last
    drive if a car touched something; the results of all other drives are then in `results.json`.
    """
    todo = cells(config)
    controllers = list(dict.fromkeys(cell.controller for cell in todo))
    require_parameters(config, controllers)
    for controller in controllers:
        make_controller(controller, LoopConfig(0.05), parameters_of(config, controller))
    for track in dict.fromkeys(cell.track for cell in todo):
        find_track(track, config.tracks_dir)
    check_light(config.light)
    for perception in dict.fromkeys(cell.perception for cell in todo):
        check_perception(perception, config.model, config.views)
    config.out.mkdir(parents=True, exist_ok=True)
    with locked_folder(config.out):
        try:
            return _drive_missing(config, todo, progress)
        finally:
            with suppress(OSError):  # a folder with files stays
                config.out.rmdir()


def _drive_missing(
    config: CompareConfig, todo: list[Cell], progress: Progress | None
) -> dict[str, Any]:
    """Make the drives of `todo` whose results are missing in the folder `config.out`; write and
    return the content of `results.json`."""
    path = config.out / RESULTS
    content = read_results(path, config)
    config = with_resolved_model(config, todo)
    known = {_key(entry): entry for entry in content["drives"]}
    codes = fingerprints(config, todo)
    missing = [cell for cell in todo if known.get(cell, {}).get("code") != codes[cell]]
    # The order of the file does not depend on which drive is done first.
    order = list(dict.fromkeys([*known, *todo]))
    lost: list[tuple[Cell, UserError]] = []

    def report(done: float, name: str) -> None:
        if progress is not None:
            progress(len(todo) - len(missing) + done, len(todo), name)

    for batch in drive_cells(config, missing, report):
        for cell, driven in batch:
            if isinstance(driven, UserError):
                lost.append((cell, driven))
            else:
                known[cell] = asdict(cell) | {"code": codes[cell]} | driven
        content["drives"] = [known[cell] for cell in order if cell in known]
        write_json(path, content)
    if lost:
        cell, error = min(lost, key=lambda one: todo.index(one[0]))
        raise type(error)(
            f"{len(lost)} of {len(todo)} drives have no result; the other results are in {path}, "
            f"and the same command drives the missing ones. The first is {cell.name}: {error}"
        )
    return content | {"drives": [known[cell] for cell in todo]}


def drive_cells(
    config: CompareConfig, missing: list[Cell], report: Report
) -> Iterator[list[tuple[Cell, Driven]]]:
    """Make the drives of the cells `missing`; yield batches of cells with their results. `report`
    is called as described at `Report`."""
    tasks = tasks_of(config, missing)
    groups = groups_at_once(config, tasks)
    done = 0
    for controller, group in groups.items():
        name = f"{controller}, {len(group)} drives at once"
        driven = partial(_report_driven, report, done, name)
        for outcomes in drive_many([tasks[cell] for cell in group], report=driven):
            done += len(outcomes)
            yield [(group[one.number], entry_of(group[one.number], one)) for one in outcomes]
    at_once = {cell for group in groups.values() for cell in group}
    for cell in missing:
        if cell not in at_once:
            share = partial(_report_share, report, done, cell.name)
            yield [(cell, drive_cell(cell, tasks[cell], share))]
            done += 1


def tasks_of(config: CompareConfig, todo: list[Cell]) -> dict[Cell, Task]:
    """Return the `DriveConfig` and the `Disturbance` of each drive in `todo`."""
    widths = {
        name: find_track(name, config.tracks_dir).width
        for name in dict.fromkeys(cell.track for cell in todo)
    }
    tuned = {
        name: config.parameters if parameters_of(config, name) else None
        for name in dict.fromkeys(cell.controller for cell in todo)
    }
    return {
        cell: (
            DriveConfig(
                controller=cell.controller,
                track=cell.track,
                perception=cell.perception,
                steps=config.steps,
                start_d=(
                    -GRID_SHARE * widths[cell.track] if config.start_d is None else config.start_d
                ),
                latency_ms=config.latency_ms,
                drop=config.drop,
                model=config.model,
                views=config.views,
                light=config.light,
                seed=cell.seed,
                parameters=tuned[cell.controller],
                tracks_dir=config.tracks_dir,
            ),
            DISTURBANCES[cell.disturbance],
        )
        for cell in todo
    }


def groups_at_once(config: CompareConfig, tasks: dict[Cell, Task]) -> dict[str, list[Cell]]:
    """Return the drives of `tasks` that `drive_many` can make in batches, by controller."""
    groups: dict[str, list[Cell]] = {}
    for cell, (drive_config, _) in tasks.items():
        if can_join(drive_config):
            groups.setdefault(cell.controller, []).append(cell)
    made = {
        name: make_controller(name, LoopConfig(0.05), parameters_of(config, name))
        for name in groups
    }
    return {
        name: group
        for name, group in groups.items()
        if callable(getattr(made[name], "update_batch", None))
    }


def entry_of(cell: Cell, outcome: Outcome) -> Driven:
    """Return the result or the error of `outcome`; the result has the curves if the seed is 0."""
    if isinstance(outcome.result, UserError):
        return outcome.result
    curves = {"curves": curves_of(outcome.curves)} if cell.seed == 0 else {}
    return {"result": outcome.result.as_json()} | curves


def drive_cell(cell: Cell, task: Task, progress: Callable[[int, int], None]) -> Driven:
    """Make one drive; return its result, with curves if the seed is 0, or the error
    ContactsUnavailable. `progress` is called with the steps done and their total number."""
    recorder = CurveRecorder()
    config, disturbance = task
    try:
        result = drive(config, progress, disturbance=disturbance, observers=[recorder])
    except ContactsUnavailable as error:
        return error
    curves = {"curves": recorder.curves()} if cell.seed == 0 else {}
    return {"result": result.as_json()} | curves


def read_results(path: Path, config: CompareConfig) -> dict[str, Any]:
    """Read `results.json`, or make its content if there is no file at `path`. Raises UserError for
    a file whose settings or version differ."""
    settings = {name: getattr(config, name) for name in SETTINGS}
    if not path.exists():
        return {"version": VERSION, "settings": settings, "drives": []}
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        found, version = {"views": 1, **content["settings"]}, content["version"]
        _ = [(_key(entry), entry["code"]) for entry in content["drives"]]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} holds no results ({error!r}); give another --out") from error
    if version != VERSION:
        raise UserError(f"{path} has version {version}, not {VERSION}; give another --out")
    for name, value in settings.items():
        if found.get(name) != value:
            raise UserError(
                f"{path} was made with {name} {found.get(name)}, now it is {value}; give another "
                "--out"
            )
    return content


def _key(entry: dict[str, Any]) -> Cell:
    return Cell(**{name: entry[name] for name in Cell.__dataclass_fields__})


def _report_driven(report: Report, before: int, name: str, driven: float) -> None:
    report(before + driven, name)


def _report_share(report: Report, done: int, name: str, step: int, steps: int) -> None:
    if step % 50 == 0:
        report(done + step / steps, name)

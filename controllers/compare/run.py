"""The drives of a comparison, and the file with their results.

`results.json` is {"version", "settings", "drives": [...]} and is written after each drive. A drive
whose result is in the file is not driven again, unless its controller or model has changed.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from controllers.compare.config import CompareConfig
from controllers.compare.curves import CurveRecorder
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES, UNDISTURBED
from controllers.drive.run import GRID_SHARE, drive, read_parameters
from controllers.interface import LoopConfig
from controllers.laws.actor import WEIGHTS, is_actor
from controllers.perception.sources import ServiceModel, check_perception
from controllers.registry import make_controller
from runtime.files import locked_folder, write_json
from simulator.camera import check_light
from simulator.track.catalogue import find_track
from simulator.world.errors import ContactsUnavailable
from trackfeatures.errors import UserError

VERSION = 3
"""Version of `results.json`."""
RESULTS, REPORT = "results.json", "report.html"
SETTINGS = ("steps", "start_d", "latency_ms", "drop", "model", "light")
"""Settings that are equal for all drives of a file."""

Progress = Callable[[int, int, str, float], None]
"""A function that is called with the number of finished drives, the number of all drives, the name
of the present drive and its finished share."""


@dataclass(frozen=True)
class Cell:
    """One drive of a comparison."""

    track: str
    controller: str
    perception: str
    disturbance: str
    seed: int

    @property
    def name(self) -> str:
        changed = "" if self.disturbance == UNDISTURBED else f", {self.disturbance}"
        return f"{self.controller} on {self.track}, {self.perception}{changed}, seed {self.seed}"


def cells(config: CompareConfig) -> list[Cell]:
    """All drives, ordered by track. Raises UserError for an empty list or fewer than one seed."""
    if config.seeds < 1:
        raise UserError(f"{config.seeds} seeds; give 1 or more")
    disturbances = list(DISTURBANCES) if config.disturb else [UNDISTURBED]
    return [
        Cell(track, controller, perception, disturbance, seed)
        for track in names(config.tracks, "tracks")
        for perception in names(config.perceptions, "perceptions")
        for disturbance in disturbances
        for controller in names(config.controllers, "controllers")
        for seed in range(config.seeds)
    ]


def names(text: str, what: str) -> list[str]:
    """The names in `text`, separated by commas, without repetition.

    Raises UserError for an empty list; `what` is the name of the option.
    """
    found = list(dict.fromkeys(filter(None, (name.strip() for name in text.split(",")))))
    if not found:
        raise UserError(f"--{what} names nothing; give names with commas between them")
    return found


def compare(config: CompareConfig, progress: Progress | None = None) -> dict[str, Any]:
    """Drive all cells without a result in `config.out`; returns the results of all cells.

    Raises UserError before the first drive for an unknown name, a folder with results of other
    settings, or a folder to which another process writes. Raises ContactsUnavailable after the last
    drive if a car touched something; the results of the other drives are in `results.json`.
    """
    todo = cells(config)
    for controller in dict.fromkeys(cell.controller for cell in todo):
        make_controller(controller, LoopConfig(0.05), parameters_of(config, controller))
    for track in dict.fromkeys(cell.track for cell in todo):
        find_track(track, config.tracks_dir)
    check_light(config.light)
    for perception in dict.fromkeys(cell.perception for cell in todo):
        check_perception(perception, config.model)
    config.out.mkdir(parents=True, exist_ok=True)
    with locked_folder(config.out):
        return _drive_missing(config, todo, progress)


def _drive_missing(
    config: CompareConfig, todo: list[Cell], progress: Progress | None
) -> dict[str, Any]:
    """Drive the cells of `todo` without a result in the folder; write each result at once."""
    path = config.out / RESULTS
    content = read_results(path, config)
    known = {_key(entry): entry for entry in content["drives"]}
    lost: list[str] = []
    for done, cell in enumerate(todo):
        report_share = _report_share(progress, done, len(todo), cell)
        report_share(0, 1)
        code = fingerprint(config, cell)
        found = known.get(cell)
        if found is None or found["code"] != code:
            try:
                driven = drive_cell(config, cell, report_share)
            except ContactsUnavailable as error:
                lost.append(f"{cell.name}: {error}")
                continue
            known[cell] = asdict(cell) | {"code": code} | driven
            content["drives"] = list(known.values())
            write_json(path, content)
    if lost:
        raise ContactsUnavailable(
            f"{len(lost)} of {len(todo)} drives have no result; the other results are in {path}, "
            f"and the same command drives the missing ones. The first is {lost[0]}"
        )
    wanted = set(todo)
    return content | {"drives": [entry for cell, entry in known.items() if cell in wanted]}


def drive_cell(
    config: CompareConfig, cell: Cell, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """The result of one drive: its figures and, for seed 0, its curves."""
    track = find_track(cell.track, config.tracks_dir)
    start = -GRID_SHARE * track.width if config.start_d is None else config.start_d
    recorder = CurveRecorder()
    result = drive(
        DriveConfig(
            controller=cell.controller,
            track=cell.track,
            perception=cell.perception,
            steps=config.steps,
            start_d=start,
            latency_ms=config.latency_ms,
            drop=config.drop,
            model=config.model,
            light=config.light,
            seed=cell.seed,
            parameters=config.parameters if parameters_of(config, cell.controller) else None,
            tracks_dir=config.tracks_dir,
        ),
        progress,
        disturbance=DISTURBANCES[cell.disturbance],
        observers=[recorder],
    )
    curves = {"curves": recorder.curves()} if cell.seed == 0 else {}
    return {"result": result.as_json()} | curves


def parameters_of(config: CompareConfig, controller: str) -> dict[str, float]:
    """The tuned parameters of a controller; {} if the file has no entry for it."""
    if config.parameters is None:
        return {}
    try:
        tuned = json.loads(config.parameters.read_text())["controllers"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{config.parameters} is no file of `controllers tune`") from error
    return read_parameters(config.parameters, controller) if controller in tuned else {}


def fingerprint(config: CompareConfig, cell: Cell) -> str:
    """A hash of the inputs of a drive that its cell does not name: the road, the tuned parameters,
    the user's file or trained actor, and the weights of the model or of the service's model."""
    digest = hashlib.sha256(json.dumps(parameters_of(config, cell.controller)).encode())
    digest.update(find_track(cell.track, config.tracks_dir).content_hash.encode())
    file = _file_of(cell.controller)
    if file is not None:
        digest.update(file.read_bytes())
    if cell.perception == "model":
        digest.update(model_hash(config.model).encode())
    elif cell.perception != "truth":
        digest.update(service_model_hash(cell.perception).encode())
    return digest.hexdigest()[:16]


def _file_of(controller: str) -> Path | None:
    """The weights of a trained actor, or the file of a user's class, whose module is imported."""
    if is_actor(Path(controller)):
        return Path(controller) / WEIGHTS
    place = controller.rpartition(":")[0]
    file = place if place.endswith(".py") else getattr(sys.modules.get(place), "__file__", None)
    return None if file is None else Path(file)


def model_hash(run: str) -> str:
    """SHA-256 of the weights of a run's model."""
    from mtlnet.inference.model_card import read_card, resolve_run

    return read_card(resolve_run(run)).model_hash


def service_model_hash(url: str) -> str:
    """SHA-256 of the weights of the model at `url`. Raises UserError if it does not answer."""
    service = ServiceModel(url)
    service.close()
    return service.model_hash


def read_results(path: Path, config: CompareConfig) -> dict[str, Any]:
    """The results so far. Raises UserError for a file of other settings or another version."""
    settings = {name: getattr(config, name) for name in SETTINGS}
    if not path.exists():
        return {"version": VERSION, "settings": settings, "drives": []}
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        found, version = content["settings"], content["version"]
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


def _report_share(
    progress: Progress | None, done: int, total: int, cell: Cell
) -> Callable[[int, int], None]:
    def share(step: int, steps: int) -> None:
        if progress is not None and step % 50 == 0:
            progress(done, total, cell.name, step / steps)

    return share


def groups(content: dict[str, Any]) -> Iterator[tuple[tuple[str, str], list[dict[str, Any]]]]:
    """The drives by (perception, disturbance), in their order in `content`."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for entry in content["drives"]:
        found.setdefault((entry["perception"], entry["disturbance"]), []).append(entry)
    yield from found.items()

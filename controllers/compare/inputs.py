"""The inputs of the drives of a comparison that their cells do not contain: tuned parameters,
roads, code of controllers and of the simulator, and models."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import simulator
import trackfeatures
from controllers.compare.cells import Cell
from controllers.compare.config import CompareConfig
from controllers.drive.run import read_parameters
from controllers.perception.sources import ServiceModel, model_identity
from controllers.registry import controller_code
from simulator.track.catalogue import find_track
from trackfeatures.errors import UserError

CODE_SUFFIXES = (".py", ".toml", ".glsl")
SERVERS = ("link", "watch")
"""Folders of the simulator that do not change a drive."""


def parameters_of(config: CompareConfig, controller: str) -> dict[str, float]:
    """Read a controller's parameters in `config.parameters`; {} if they are not in this file."""
    if config.parameters is None or controller not in _tuned(config.parameters):
        return {}
    return read_parameters(config.parameters, controller)


def require_parameters(config: CompareConfig, controllers: Iterable[str]) -> None:
    """Raise UserError if the file `config.parameters` has parameters of none of the
    `controllers`."""
    if config.parameters is None:
        return
    tuned = _tuned(config.parameters)
    if tuned.keys().isdisjoint(controllers):
        raise UserError(
            f"{config.parameters} has parameters of {', '.join(tuned) or 'no controller'}, but "
            f"not of {', '.join(controllers)}; name a controller of the file in --controllers, or "
            "leave --parameters out"
        )


def _tuned(path: Path) -> dict[str, Any]:
    """Read the entries, by controller, of a file that `controllers tune` wrote."""
    try:
        tuned = json.loads(path.read_text())["controllers"]
        if not isinstance(tuned, dict):
            raise TypeError(f"controllers is {tuned!r}")
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no file of `controllers tune` ({error!r})") from error
    return tuned


def with_resolved_model(config: CompareConfig, todo: list[Cell]) -> CompareConfig:
    """Return `config` with the folder of the model in place of its name if a drive in `todo` uses
    the model. All drives then use one model, even if "latest" becomes another run meanwhile."""
    if all(cell.perception != "model" for cell in todo):
        return config
    from mtlnet.inference.model_card import resolve_run

    return replace(config, model=str(resolve_run(config.model)))


def fingerprints(config: CompareConfig, todo: list[Cell]) -> dict[Cell, str]:
    """Return, for each drive, a hash of the inputs that its cell does not contain: the tuned
    parameters, the road (for images also its paint and scenery), the controller's files, the
    simulator's files, and what determines the answers of the model or service."""
    tracks = {
        name: find_track(name, config.tracks_dir)
        for name in dict.fromkeys(cell.track for cell in todo)
    }
    parameters, code = {}, {}
    for name in dict.fromkeys(cell.controller for cell in todo):
        parameters[name] = json.dumps(parameters_of(config, name)).encode()
        code[name] = controller_code(name)
    models = {
        name: _model_of(config, name).encode()
        for name in dict.fromkeys(cell.perception for cell in todo)
    }
    codes = {}
    for cell in todo:
        track = tracks[cell.track]
        road = track.driving_hash if cell.perception == "truth" else track.picture_hash
        used = parameters[cell.controller], road.encode(), code[cell.controller], simulator_code()
        codes[cell] = hashlib.sha256(b"".join((*used, models[cell.perception]))).hexdigest()[:16]
    return codes


@cache
def simulator_code() -> bytes:
    """Return a hash of the files that determine how cars move and what they see: code, tables and
    shaders of the packages `simulator` (without its servers) and `trackfeatures`."""
    content = hashlib.sha256()
    for package in (simulator, trackfeatures):
        folder = Path(package.__path__[0])
        for file in sorted(folder.rglob("*")):
            name = file.relative_to(folder)
            if file.suffix in CODE_SUFFIXES and name.parts[0] not in SERVERS:
                content.update(f"{name}\0{file.stat().st_size}\0".encode())
                content.update(file.read_bytes())
    return content.digest()


def _model_of(config: CompareConfig, perception: str) -> str:
    """Return what determines the answers of the perception's model; "" for `truth` (no model)."""
    if perception == "truth":
        return ""
    return model_identity(config.model) if perception == "model" else service_identity(perception)


def service_identity(url: str) -> str:
    """Return what determines the answers of the service at `url` (`ServiceModel.identity`). Raises
    UserError if it does not answer."""
    service = ServiceModel(url)
    service.close()
    return service.identity

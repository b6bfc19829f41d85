"""Opening a dataset folder for a plan: new, empty, or the beginning of this very plan."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.plan import Plan, program
from datagen.recording.errors import DatasetError
from datagen.recording.folder import barely_begun, prepare, write_synced
from datagen.recording.splits import SIDES, Split, split_path, write_split

PLAN = "plan.json"


def require_fitting(folder: Path, plan: Plan) -> None:
    """The folder is new, empty, or holds the beginning of this very plan."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DatasetError(f"{folder} is a file; choose a folder with --out")
    path = folder / PLAN
    if not path.is_file():
        if not barely_begun(folder, PLAN):
            raise DatasetError(
                f"{folder} exists and is not a dataset of `datagen collect` (it has no {PLAN}); "
                "nothing was changed; choose another folder with --out"
            )
        return
    try:
        found = json.loads(path.read_text())
        found_hash, definitions, wanted = found["hash"], found["definitions"], found["wanted"]
        maker = found["program"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error!r}); choose another folder with --out"
        ) from error
    tf.require_version(str(definitions), str(folder))
    if maker != program():
        raise DatasetError(
            f"{folder} was made by {maker}, this is {program()}; finish it with that "
            "version, or choose another folder with --out"
        )
    if found_hash != plan.hash:
        raise DatasetError(
            f"{folder} was begun with another plan ({_differences(wanted, plan)}); give the same "
            "options to finish it, or choose another folder with --out"
        )

    if foreign := foreign_files(folder, plan):
        raise DatasetError(
            f"{foreign[0]} is no round of this plan; move it out of the dataset, or choose another "
            "folder with --out"
        )


def foreign_files(folder: Path, plan: Plan) -> list[Path]:
    """What lies among the rounds and is not of them: it would be read as one."""
    names = {f"{entry.id}.mcap" for entry in plan.rounds}
    return [path for path in sorted(folder.glob("rounds/*.mcap")) if path.name not in names]


def _differences(found: dict[str, Any], plan: Plan) -> str:
    wanted = json.loads(json.dumps(asdict(plan.wanted)))
    named = [
        f"{name}: {_short(found.get(name))} there, {_short(value)} asked for"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
    return "; ".join(named) or "dealt otherwise"


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(v["name"] if isinstance(v, dict) else v) for v in value)
    return str(value)


def open_folder(folder: Path, plan: Plan) -> None:
    """Write what the rounds are to be found with, whatever happens to them."""
    # First of all: by its plan the same command knows the folder again, whatever fails next.
    write_synced(folder / PLAN, json.dumps(plan.as_json(), indent=1) + "\n")
    prepare(folder)
    write_split(split_path(folder), split_of(plan, {entry.id for entry in plan.rounds}))


def split_of(plan: Plan, finished: set[str]) -> Split:
    """The plan's split, of the rounds that are there."""
    return Split(
        **{
            side: tuple(e.id for e in plan.rounds if e.split == side and e.id in finished)
            for side in SIDES
        }
    )

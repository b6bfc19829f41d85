"""Verifies a dataset folder: every round, the splits and the manifest.

A damaged file is reported as a problem and raises no exception.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import trackfeatures as tf
from datagen.recording.dataset import dataset_hash, round_files
from datagen.recording.errors import DatasetError
from datagen.recording.folder import RoundState, round_path
from datagen.recording.integrity.round_checks import LEVELS, check_round, describe_read_error
from datagen.recording.manifest import manifest_problems
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.names import SIDES
from datagen.recording.splits import (
    RoundKey,
    read_split,
    require_disjoint,
    require_recovered_declared,
)


@dataclass(frozen=True, slots=True)
class Report:
    """The result of `datagen verify`; its fields are the keys of `--json`.

    `content_hash` is the hash of the dataset, None if a round cannot be read.
    """

    ok: bool
    rounds: int
    frames: int
    problems: tuple[str, ...]
    content_hash: str | None = None
    recovered: tuple[str, ...] = ()
    """Rounds saved by `datagen recover`, one line each; not a problem by themselves."""


def verify(
    folder: Path, level: str, on_round_done: Callable[[str], None] = lambda round_id: None
) -> Report:
    """Check every round at `level` (quick, full or deep), the splits and the manifest.

    The rounds are checked on one thread per core. `on_round_done` is called with the id of each
    checked round, on any of these threads. Raises DatasetError for an unknown level.
    """
    if level not in LEVELS:
        raise DatasetError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    try:
        files = round_files(folder)
    except DatasetError as error:
        return Report(False, 0, 0, (str(error),))

    def check(file: Path) -> tuple[int, list[str]]:
        done = _check(folder, file, level)
        on_round_done(file.stem)
        return done

    # Threads suffice, because hashing, CRCs and decoding take nearly all of the time and release
    # the GIL.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        checked = list(pool.map(check, files))
    problems = [problem for _, found in checked for problem in found]
    rounds = list(_open_readable(files))
    problems += [
        *_missing_rounds(folder),
        *_unexpected_files(folder),
        *_duplicate_rounds(rounds),
        *_split_problems(folder, rounds),
    ]
    if level != "quick" and not problems:
        problems += _manifest_problems(folder)
    return Report(
        not problems,
        len(files),
        sum(frames for frames, _ in checked),
        tuple(problems),
        dataset_hash(r.result.content_hash for r in rounds) if len(rounds) == len(files) else None,
        tuple(f"{r.header.id}: {r.recovery}" for r in rounds if r.recovery),
    )


def _check(folder: Path, file: Path, level: str) -> tuple[int, list[str]]:
    path = folder / "state" / f"{file.stem}.json"
    state, problems = None, []
    try:
        state = RoundState.read(path) if path.is_file() else None
    except DatasetError as error:
        problems.append(str(error))
    except OSError as error:
        problems.append(describe_read_error(path, error))
    if state is not None and state.file != f"rounds/{file.name}":
        problems.append(f"{path} belongs to {state.file}")
    frames, found = check_round(file, level, state)
    return frames, problems + found


def _open_readable(files: list[Path]) -> Iterator[RoundIndex]:
    for file in files:
        try:
            yield open_round(file)
        except (DatasetError, OSError):
            continue  # reported by check_round


def _manifest_problems(folder: Path) -> Iterator[str]:
    try:
        yield from manifest_problems(folder)
    except tf.UserError as error:
        yield str(error)
    except OSError as error:
        yield describe_read_error(Path(error.filename or folder), error)


def _missing_rounds(folder: Path) -> Iterator[str]:
    """Yield a problem for each round with a state but without a file."""
    for path in sorted((folder / "state").glob("*.json")):
        if not (folder / "rounds" / f"{path.stem}.mcap").is_file():
            yield f"{path.stem}.mcap is missing: state/{path.name} lists it as recorded"


def _unexpected_files(folder: Path) -> Iterator[str]:
    """Yield a problem for each file in `rounds/` that is no round."""
    for path in sorted((folder / "rounds").iterdir()):
        if path.suffix != ".mcap":
            yield f"{path} is no round (expected *.mcap); move it elsewhere"


def _duplicate_rounds(rounds: list[RoundIndex]) -> Iterator[str]:
    """Yield a problem for each file whose name is not the id of its round, and for each file with
    the same images and labels as a file before it."""
    contents: dict[str, str] = {}
    for index in rounds:
        name, header = index.path.name, index.header
        if header.id != index.path.stem:
            yield (
                f"{name} holds round {header.id}: files were swapped, copied or renamed; give each "
                "the name of its round"
            )
        first = contents.setdefault(index.result.content_hash, name)
        if first != name:
            yield f"{name} has the same images and labels as {first}; keep one of them"


def _split_problems(folder: Path, rounds: list[RoundIndex]) -> Iterator[str]:
    keys = [RoundKey(r.header.id, r.header.seed, r.result.content_hash) for r in rounds]
    paths = sorted((folder / "splits").glob("*.json"))
    if not paths:
        yield f"there are no splits in {folder / 'splits'}"
    for path in paths:
        try:
            split = read_split(path)
            require_disjoint(split, keys)
            require_recovered_declared(split, rounds, path)
        except (DatasetError, tf.DefinitionsMismatch) as error:
            yield str(error)
        except OSError as error:
            yield describe_read_error(path, error)
        else:
            named = [round_id for side in SIDES for round_id in getattr(split, side)]
            for round_id in sorted(set(named)):
                if named.count(round_id) > 1:
                    yield f"{path} names round {round_id} twice"
                if not round_path(folder, round_id).is_file():
                    yield f"{path} names round {round_id}, which does not exist"

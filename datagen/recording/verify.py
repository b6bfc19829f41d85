"""Whether a dataset folder is what was recorded; a bad file is reported, never raised."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import trackfeatures as tf

from .check import check_round, unreadable
from .dataset import round_files
from .errors import DatasetError
from .folder import RoundState, round_path, state_path
from .index import open_round
from .splits import RoundKey, read_split, require_disjoint


@dataclass(frozen=True, slots=True)
class Report:
    """The result of `datagen verify`."""

    ok: bool
    rounds: int
    frames: int
    problems: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        return {**asdict(self), "problems": list(self.problems)}


def verify(folder: Path, level: str, seen: Callable[[str], None] = lambda name: None) -> Report:
    """Check every round at `level` (quick, full or deep) and the splits; `seen` hears of each."""
    try:
        files = round_files(folder)
    except DatasetError as error:
        return Report(False, 0, 0, (str(error),))
    frames, problems = 0, []
    for file in files:
        try:
            state = _state_of(folder, file)
        except DatasetError as error:
            state = None
            problems.append(str(error))
        except OSError as error:
            state = None
            problems.append(unreadable(state_path(folder, file.stem), error))
        count, found = check_round(file, level, state)
        frames += count
        problems += found
        seen(file.stem)
    problems += _missing(folder)
    problems += _splits(folder, files)
    return Report(not problems, len(files), frames, tuple(problems))


def _state_of(folder: Path, file: Path) -> RoundState | None:
    path = state_path(folder, file.stem)
    return RoundState.read(path) if path.is_file() else None


def _missing(folder: Path) -> list[str]:
    """Rounds that were finished once and whose file is gone."""
    names = [path.stem for path in sorted((folder / "state").glob("*.json"))]
    return [
        f"{name}.mcap is missing: state/{name}.json says that it was recorded"
        for name in names
        if not round_path(folder, name).is_file()
    ]


def _splits(folder: Path, files: list[Path]) -> list[str]:
    keys = []
    for file in files:
        try:
            index = open_round(file)
        except (DatasetError, OSError):
            continue  # already told
        keys.append(RoundKey(index.header.id, index.header.seed, index.result.content_hash))
    problems = []
    paths = sorted((folder / "splits").glob("*.json"))
    for path in paths:
        try:
            require_disjoint(read_split(path), keys)
        except (DatasetError, tf.DefinitionsMismatch) as error:
            problems.append(str(error))
        except OSError as error:
            problems.append(unreadable(path, error))
    return problems or ([] if paths else [f"there are no splits in {folder / 'splits'}"])

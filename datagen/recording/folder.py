"""A dataset folder on disk: how a round gets into it whole or not at all.

A round is written under `.partial/`, read back, checked, hashed, synced and renamed into `rounds/`;
`state/ID.json` then holds its hashes. Everything else in the folder is derived and can be rebuilt.
"""

import hashlib
import json
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

from datagen.recording.errors import DatasetError
from datagen.recording.schema.json_schema import SCHEMA, schema_text
from runtime.files import atomic_move, atomic_write, unfinished_path

PARTIAL = ".partial"
LOCKS = ".locks"
SUBFOLDERS = ("rounds", "state", "splits", "layouts", "proto", "schemas")
PUBLISHED = ("proto/driverview.proto", "layouts/foxglove.json", SCHEMA)
READ_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class RoundState:
    """What is known of a finished file: enough to see that it is still the same."""

    id: str
    file: str
    bytes: int
    sha256: str
    frames: int
    content_hash: str
    definitions: str

    @staticmethod
    def read(path: Path) -> "RoundState":
        try:
            return RoundState(**json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise DatasetError(f"{path} is no round state: {error}") from error


def prepare(folder: Path) -> None:
    """Make the folder's parts and publish what explains its messages."""
    for name in SUBFOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    package = files("datagen.recording.schema")
    for name in PUBLISHED:
        text = schema_text() if name == SCHEMA else package.joinpath(name).read_text()
        write_if_changed(folder / name, text)


def is_unstarted(folder: Path, first_file: str) -> bool:
    """Whether `folder` holds at most empty parts of a dataset and an unfinished `first_file`.

    That is what a disk that was full from the start leaves; `first_file` is written before all
    others.
    """
    return all(
        path.name in (unfinished_path(folder / first_file).name, LOCKS)
        or (path.name in (*SUBFOLDERS, PARTIAL) and path.is_dir() and not any(path.iterdir()))
        for path in folder.iterdir()
    )


def round_path(folder: Path, round_id: str) -> Path:
    return folder / "rounds" / f"{round_id}.mcap"


def state_path(folder: Path, round_id: str) -> Path:
    return folder / "state" / f"{round_id}.json"


def partial_path(folder: Path, round_id: str) -> Path:
    """Where to write a round that is not finished; its own folder, made empty."""
    home = folder / PARTIAL / round_id
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    return home / "round.mcap"


def publish(folder: Path, partial: Path, state: RoundState) -> None:
    """Move a checked round to its place: after a power cut it is there whole or not at all."""
    atomic_move(partial, round_path(folder, state.id))
    write_if_changed(state_path(folder, state.id), json.dumps(asdict(state), indent=1) + "\n")
    discard_partial(folder, state.id)


def discard_partial(folder: Path, round_id: str) -> None:
    """What an attempt has left. Its parent stays: another round may be about to begin in it."""
    shutil.rmtree(folder / PARTIAL / round_id, ignore_errors=True)


def discard_partials(folder: Path, round_ids: Iterable[str]) -> None:
    """What a crash or an interruption has left of these rounds."""
    for round_id in round_ids:
        discard_partial(folder, round_id)
    with suppress(OSError):  # it is not there, or other rounds are being written in it
        (folder / PARTIAL).rmdir()


def read_states(folder: Path) -> dict[str, RoundState]:
    """States of the rounds that are finished: the file is there and has its length."""
    states = {}
    for path in sorted((folder / "state").glob("*.json")):
        state = RoundState.read(path)
        file = folder / state.file
        if file.is_file() and file.stat().st_size == state.bytes:
            states[state.id] = state
    return states


def file_sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(READ_BYTES):
            digest.update(block)
    return digest.hexdigest()


def write_if_changed(path: Path, text: str) -> None:
    """Replace a small file in one step, on the disk; a file that holds `text` already is kept."""
    if not (path.is_file() and path.read_bytes() == text.encode()):
        atomic_write(path, text, fsync=True)

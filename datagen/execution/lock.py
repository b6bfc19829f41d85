"""Who may write to a dataset folder: one collector, or one for each shard of the same plan.

Locks are on files in `.locks/` and end with the process that holds them, however it ends. They are
`flock` locks: Linux carries them over NFS too.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.planning.plan import Shard
from datagen.recording.errors import DatasetError
from datagen.recording.folder import LOCKS

FOLDER, SETTING_UP = "folder", "setting-up"


@contextmanager
def held(folder: Path, shard: Shard | None) -> Iterator[None]:
    """Hold the folder, or its part `shard`. Raises DatasetError when another collector has it."""
    (folder / LOCKS).mkdir(exist_ok=True)
    with _open(folder, FOLDER) as whole:
        if not _try(whole, fcntl.LOCK_EX if shard is None else fcntl.LOCK_SH):
            raise DatasetError(
                f"another `datagen collect` is writing to {folder}; wait for it or choose another "
                "--out"
            )
        if shard is None:
            yield
            return
        name = f"shard-{shard.number}-of-{shard.count}"
        with _open(folder, name) as mine:
            if not _try(mine, fcntl.LOCK_EX):
                raise DatasetError(f"shard {shard} of {folder} is being recorded already")
            _require_same_count(folder, shard)
            yield


@contextmanager
def setting_up(folder: Path) -> Iterator[None]:
    """Alone for a moment: what all shards write alike is written by one at a time."""
    with _open(folder, SETTING_UP) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def _require_same_count(folder: Path, shard: Shard) -> None:
    """Shards of another division would record the same rounds at the same time."""
    for path in sorted((folder / LOCKS).glob("shard-*-of-*")):
        if path.name.endswith(f"-of-{shard.count}"):
            continue
        with _open(folder, path.name) as other:
            if not _try(other, fcntl.LOCK_EX):
                raise DatasetError(
                    f"{path.name} of {folder} is being recorded, which does not go with shard "
                    f"{shard}; divide by the same number, or wait for it"
                )


@contextmanager
def _open(folder: Path, name: str) -> Iterator[int]:
    descriptor = os.open(folder / LOCKS / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _try(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

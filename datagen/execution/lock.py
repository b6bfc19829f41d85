"""Locks a dataset folder: only one collector can write to it, or one for each shard of a plan.

The locks are `flock` locks on files in `.locks/`. The operating system releases them when the
process ends, however it ends. On Linux they also work over NFS.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.planning.plan import Shard
from datagen.recording.errors import DatasetError
from datagen.recording.folder import LOCKS
from runtime.files import try_lock

FOLDER_LOCK, SETUP_LOCK = "folder", "setting-up"


@contextmanager
def folder_lock(folder: Path, shard: Shard | None) -> Iterator[None]:
    """Lock the folder within the block. With `shard`, lock only this shard of the plan. Raises
    DatasetError if another collector holds the lock."""
    (folder / LOCKS).mkdir(exist_ok=True)
    with _open(folder, FOLDER_LOCK) as descriptor:
        if not try_lock(descriptor, shared=shard is not None):
            raise DatasetError(
                f"another `datagen collect` is writing to {folder}; wait for it or choose another "
                "--out"
            )
        if shard is None:
            yield
            return
        name = f"shard-{shard.number}-of-{shard.count}"
        with _open(folder, name) as shard_descriptor:
            if not try_lock(shard_descriptor):
                raise DatasetError(
                    f"shard {shard} of {folder} is being recorded by another `datagen collect`; "
                    "wait for it or give another --shard"
                )
            _require_same_count(folder, shard)
            yield


@contextmanager
def setup_lock(folder: Path) -> Iterator[None]:
    """Lock the files that all shards write (plan, split, manifest) within the block. Waits while
    another collector holds the lock."""
    with _open(folder, SETUP_LOCK) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def _require_same_count(folder: Path, shard: Shard) -> None:
    """Raise DatasetError if a running collector divides the plan into another number of shards than
    `shard.count`. The two collectors would record the same rounds."""
    for path in sorted((folder / LOCKS).glob("shard-*-of-*")):
        if path.name.endswith(f"-of-{shard.count}"):
            continue
        with _open(folder, path.name) as other:
            if not try_lock(other):
                raise DatasetError(
                    f"{path.name} of {folder} is being recorded, which overlaps with shard "
                    f"{shard}; use the same number of shards, or wait for it"
                )


@contextmanager
def _open(folder: Path, name: str) -> Iterator[int]:
    descriptor = os.open(folder / LOCKS / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        yield descriptor
    finally:
        os.close(descriptor)

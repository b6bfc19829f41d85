"""Defines and counts the datasets of a GPU run: three for evaluation, one for training.

`test` has the tracks that models are trained on; four fifths of its rounds are test rounds, and the
timed recipes train on the remaining fifth. `unseen` has tracks that no model is trained on.
`random` has random roads of varied appearance. Half of the rounds of `train` are on the training
tracks, with lanes of 4.0 m, and half are on random roads of varied appearance. The parts of `train`
are collected at the same time, because one core needs 20 s to plan random roads. Then the parts are
merged.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gpu.plan import Size
from benchmarks.gpu.process import Command, Ended, log_tail
from datagen.recording import Dataset, DatasetError

SEEDS = {"test": 3601, "unseen": 3602, "random": 3603, "train": 3610}
"""No model has been trained on rounds with these seeds. Part n of `train` has its seed plus n."""
FREQUENCY_HZ = 4
VARIED = ("--roads", "varied", "--tracks", "random")
WORKERS_A_PART = 4
IMAGE_BYTES = (210 - 66) * 280 * 3
"""Bytes of a frame in GPU memory: RGB, without the sky (the upper 66 of 210 rows)."""
MEMORY_SHARE = 0.5
"""Share of the GPU's memory that the train frames may fill. The loader uses at most 0.6 of the free
memory."""


@dataclass(frozen=True)
class Collection:
    """One call of `datagen collect`."""

    name: str
    seed: int
    rounds: int
    frames: int
    workers: int
    options: tuple[str, ...]

    def command(self, folder: Path) -> Command:
        """Return the command that records into `folder`/NAME. Its output and its log are files in
        `folder`."""
        words = [sys.executable, "-m", "datagen", "collect", "--json"]
        words += ["--out", str(folder / self.name), "--prefix", self.name]
        words += ["--seed", str(self.seed), "--frequency", str(FREQUENCY_HZ)]
        words += ["--rounds", str(self.rounds), "--frames", str(self.frames)]
        words += ["--workers", str(self.workers), *self.options]
        log = folder / f"{self.name}.log"
        return Command(tuple(words), folder / f"{self.name}.json", log)


def evaluation_collections(size: Size, cores: int) -> list[Collection]:
    """Return the collections `test`, `unseen` and `random`. The number of workers of a collection
    is in proportion to the number of its rounds."""
    rounds = {"test": size.test_rounds, "unseen": size.unseen_rounds, "random": size.random_rounds}
    options: dict[str, tuple[str, ...]] = {
        "test": ("--split-test-share", "0.8"),
        "unseen": ("--split", "unseen"),
        "random": ("--split", "unseen", *VARIED),
    }
    total = sum(rounds.values())
    return [
        Collection(name, SEEDS[name], count, size.frames, -(-cores * count // total), options[name])
        for name, count in rounds.items()
    ]


def train_collections(size: Size, cores: int, frames: int) -> list[Collection]:
    """Return the parts of `train`, which together have at least `frames` frames. The parts are
    alternately on the training tracks and on random roads."""
    parts = max(2 * (cores // (2 * WORKERS_A_PART)), 2)
    rounds = max(-(-frames // (parts * size.train_frames)), 1)
    share = ("--split-test-share", "0", "--stretch", "1")
    return [
        Collection(
            f"part{number}",
            SEEDS["train"] + number,
            rounds,
            size.train_frames,
            max(cores // parts, 1),
            (*share, *VARIED) if number % 2 else share,
        )
        for number in range(parts)
    ]


def most_frames(size: Size, gpu_bytes: int) -> int:
    """Return the number of train frames that fit into the GPU's memory of `gpu_bytes`, but at most
    `size.most_train_frames`.

    Without a GPU (`gpu_bytes` is 0) the result is `size.most_train_frames`.
    """
    if not gpu_bytes:
        return size.most_train_frames
    return min(size.most_train_frames, int(MEMORY_SHARE * gpu_bytes / IMAGE_BYTES))


def counted(folder: Path, collections: list[Collection], ended: list[Ended]) -> dict[str, Any]:
    """Return the numbers of frames in the finished rounds by collection, and the speed of all
    collections together.

    `whole_frames_per_second` is the number of frames divided by the time from the start of the
    calls of `datagen collect` to the end of the last call, including planning. `frames_per_second`
    is the sum of the recording speeds that the calls print, None if a call was stopped or lost
    rounds.
    """
    frames = {each.name: finished_frames(folder / each.name) for each in collections}
    seconds = max(end.seconds for end in ended)
    stopped = any(end.stopped for end in ended)
    incomplete = {
        each.name: log_tail(folder / f"{each.name}.log").splitlines()[-1:]
        for each, end in zip(collections, ended, strict=True)
        if end.code and not end.stopped
    }
    return {
        "frames": frames,
        "collecting_seconds": seconds,
        "incomplete": incomplete,
        "frames_per_second": None
        if stopped or incomplete
        else round(sum(_speed(folder, each) for each in collections), 1),
        "whole_frames_per_second": round(sum(frames.values()) / seconds, 1),
        "recording_was_stopped": stopped,
    }


def finished_frames(folder: Path) -> int:
    """Number of frames in the finished rounds of a dataset; 0 if `folder` is no dataset."""
    try:
        return sum(info.frames for info in Dataset.open(folder).rounds)
    except DatasetError:
        return 0


def _speed(folder: Path, collection: Collection) -> float:
    """Return the frames per second that `datagen collect` printed for `collection`."""
    said = json.loads((folder / f"{collection.name}.json").read_text(encoding="utf-8"))
    return float(said["frames_per_second"])

"""Measures the training speed on a CPU. The two kinds of steps that a claim compares take turns.

Run: `python benchmarks/training.py [--data DIR] [--quick] [--json FILE]`. Claims for the recipe
`fast` with the network `mtl` (not `grid`, the recipe's default) on a quiet machine: (1) In batches
of 32, a step with real data (reading, decoding, all augmentations) takes at most 1.05 times as long
as a step on one batch in memory. (2) In batches of the recipe's size, our loop trains on at least
2.0 times (aim: 2.5) as many images per second as a plain loop with the same batch size and files:
the network in plain torch layers, float32, AdamW, a DataLoader with two workers that decodes and
mirrors the images. The timed steps are spread over a whole run, in which more and more layers are
frozen. Ratios named `all` are for steps in which no layer is frozen.
"""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2
import numpy as np
import simplejpeg
import torch
from torch import Tensor

import trackfeatures as tf
from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import collect_few
from datagen.recording import Dataset, Frames
from mtlnet.architecture import MTL
from mtlnet.data.loader import Loader
from mtlnet.model.network import Network, initialise
from mtlnet.training.device import keep_freed_memory
from mtlnet.training.losses.multi_task import multi_task_loss
from mtlnet.training.losses.task_weighting import TaskWeighting
from mtlnet.training.recipes import RECIPES, WARM_UP
from mtlnet.training.trainer import MIN_STEPS_BEFORE_BN_FREEZE, Trainer
from trackfeatures.camera import CameraParameters

MOST_OVER_MEMORY = 1.05
LEAST_OVER_PLAIN = 2.0
AIM_OVER_PLAIN = 2.5
SMALL = 32
OWN = RECIPES["fast"].batch
ALPHA = (0.3, 0.2, 0.5)
CORES = len(os.sched_getaffinity(0))

Step = Callable[[], object]


def ours(frames: Frames, size: int, steps: int) -> dict[str, Step]:
    """Return our training steps by name: on new batches with and without augmentation, and on one
    batch in memory.

    The progress of the run goes from 0 to 1 in `steps` calls of a step, so layers freeze as in a
    whole run. The steps named `all` stay at the start of a run, where all layers learn.
    """
    recipe = RECIPES["fast"]
    camera = CameraParameters()
    changed = Loader(frames, camera, size, 0, augment=True)
    trainer = Trainer(recipe, ALPHA, 0, torch.device("cpu"), MTL)
    trainer.standardise(changed)
    trainer.step_number = MIN_STEPS_BEFORE_BN_FREEZE
    kept = changed.make(0)
    fresh = changed.batches(0)
    plain = Loader(frames, camera, size, 0, augment=False).batches(0)
    places = [cycle((number + 0.5) / steps for number in range(steps)) for _ in range(3)]
    return {
        "memory": lambda: trainer.step(kept, next(places[0])),
        "data": lambda: trainer.step(next(fresh), next(places[1])),
        "data_unchanged": lambda: trainer.step(next(plain), next(places[2])),
        "memory_all": lambda: trainer.step(kept, WARM_UP),
        "data_all": lambda: trainer.step(next(fresh), WARM_UP),
    }


def plain(frames: Frames, size: int) -> Step:
    """Return a plain torch training step with the same decoder and network, AdamW and a
    DataLoader."""
    from torch.utils.data import DataLoader
    from torch.utils.data import Dataset as TorchDataset

    labels = frames.labels
    coded = tf.encode(labels.distances, labels.angle)

    class Items(TorchDataset[tuple[Tensor, Tensor, Tensor]]):
        def __len__(self) -> int:
            return len(frames)

        def __getitem__(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
            image = simplejpeg.decode_jpeg(frames.jpeg(i), "RGB")
            target, heading = coded[i], int(labels.heading[i])
            if np.random.default_rng(i).random() < 0.5:
                image = np.ascontiguousarray(image[:, ::-1])
                target, heading = tf.mirror_coded(target)[0], 2 - heading
            return torch.from_numpy(image), torch.from_numpy(target), torch.tensor(heading)

    def forever() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        loader = DataLoader(
            Items(), size, shuffle=True, drop_last=True, num_workers=2, persistent_workers=True
        )
        while True:
            yield from loader

    network = Network(batch_norm=True, architecture=MTL)
    initialise(network, 0)
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), 1e-3)
    weighting = TaskWeighting("fixed", ALPHA, torch.device("cpu"))
    batches = forever()

    def step() -> None:
        images, target, heading = next(batches)
        losses = multi_task_loss(network(images), target, heading, weighting.total)
        optimiser.zero_grad()
        torch.autograd.backward(losses.total)
        optimiser.step()

    return step


def measure(frames: Frames, size: int, rounds: int, steps: int) -> dict[str, Any]:
    """Time every kind of step. In each of the `rounds` turns, every kind makes `steps` steps.

    Returns the medians over the turns of the times of a step (ms), the images per second and the
    ratios of the claims.
    """
    ways = {"plain": plain(frames, size), **ours(frames, size, steps)}
    times: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds + 1):
        for name, step in ways.items():
            begin = time.perf_counter()
            for _ in range(steps):
                step()
            if number:  # the first turn warms up
                times[name].append(1e3 * (time.perf_counter() - begin) / steps)
    median = {name: statistics.median(found) for name, found in times.items()}
    # The machine's speed changes between turns, so the ratio is computed within each turn.
    pairs = {
        "data_to_memory": ("data", "memory"),
        "ours_to_plain": ("plain", "data"),
        "data_to_memory_all": ("data_all", "memory_all"),
        "ours_to_plain_all": ("plain", "data_all"),
    }
    ratios = {
        name: round(statistics.median(a / b for a, b in zip(times[x], times[y], strict=True)), 3)
        for name, (x, y) in pairs.items()
    }
    return {
        "step_ms": {name: round(value, 1) for name, value in median.items()},
        "best_step_ms": {name: round(min(found), 1) for name, found in times.items()},
        "images_per_second": {name: round(1e3 * size / v, 1) for name, v in median.items()},
        **ratios,
    }


def judge(frames: Frames, rounds: int, steps: int) -> dict[str, Any]:
    """Measure with batches of 32 and with batches of the recipe's size, and compare the results
    with the claims."""
    torch.set_num_threads(CORES)
    cv2.setNumThreads(1)
    found = {size: measure(frames, size, rounds, steps) for size in (SMALL, OWN)}
    to_memory = found[SMALL]["data_to_memory"]
    to_plain = found[OWN]["ours_to_plain"]
    return {
        "frames": len(frames),
        "cores": CORES,
        **{f"batch_{size}": result for size, result in found.items()},
        "reached": {
            "data_to_memory": to_memory <= MOST_OVER_MEMORY,
            "ours_to_plain": to_plain >= LEAST_OVER_PLAIN,
        },
        "aim_reached": to_plain >= AIM_OVER_PLAIN,
        "gpu": "not measured",
    }


def main(data: Path | None = None, quick: bool = False, json: Path | None = None) -> None:
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as home:
        data = data or collect_few(Path(home) / "few", rounds=4, frames=300)
        frames = Dataset.open(data).select("train")
        result = judge(frames, *((3, 4) if quick else (7, 8)))  # turns, steps per turn
    conclude(result, json, all(result["reached"].values()))


if __name__ == "__main__":
    run_command(main)

"""Images per second read from shuffled rounds into uint8 batches, and time to open a dataset.

Run: `python benchmarks/loader.py [--data DIR] [--json FILE]`. Claims, on two cores with the files
in the page cache: the training loader reads at least 6,500 images per second, at least twice as
many as a torch DataLoader with two workers on the same files, and at least five times as many as
the `mcap` reader, which reads one image at a time; 60 rounds are opened in at most 150 ms.

`decoder` in the result is simplejpeg alone, with one thread per core: the upper limit. `ours` is
the training loader. `dataloader` is the loader of a typical user: `simplejpeg` for each item,
default collation, shuffled, two persistent workers. It finds the images by the index of this
project; with the official `mcap` reader it would be far slower.
"""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import enlarged_few
from datagen.recording import Dataset, Frames

LEAST_IMAGES_PER_SECOND = 6500.0
LEAST_OVER_DATALOADER = 2.0
LEAST_OVER_MCAP = 5.0
MOST_OPEN_MS = 150.0
ROUNDS = 60
BATCH = 32
CORES = len(os.sched_getaffinity(0))

Read = Callable[[], int]  # reads some images and returns their number


def decoder(frames: Frames, order: NDArray[np.int64]) -> Read:
    images = [bytes(frames.jpeg(int(i))) for i in order[:2048]]

    def part(which: int) -> None:
        out = np.empty((frames.camera.height, frames.camera.width, 3), np.uint8)
        for image in images[which::CORES]:
            simplejpeg.decode_jpeg(image, "RGB", buffer=out)

    pool = ThreadPoolExecutor(CORES)

    def read() -> int:
        list(pool.map(part, range(CORES)))
        return len(images)

    return read


def ours(frames: Frames, batches: int) -> Read:
    from mtlnet.data.loader import Loader
    from trackfeatures.camera import CameraParameters

    camera = CameraParameters(width=frames.camera.width, height=frames.camera.height)
    endless = Loader(frames, camera, BATCH, 0, augment=False).batches(0)

    def read() -> int:
        return sum(len(next(endless).images) for _ in range(batches))

    return read


def dataloader(frames: Frames, batches: int) -> Read:
    import torch
    from torch.utils.data import DataLoader
    from torch.utils.data import Dataset as TorchDataset

    class Items(TorchDataset[torch.Tensor]):
        def __len__(self) -> int:
            return len(frames)

        def __getitem__(self, i: int) -> torch.Tensor:
            return torch.from_numpy(simplejpeg.decode_jpeg(frames.jpeg(i), "RGB"))

    def forever() -> Iterator[torch.Tensor]:
        loader = DataLoader(
            Items(), BATCH, shuffle=True, drop_last=True, num_workers=2, persistent_workers=True
        )
        while True:
            yield from loader

    endless = forever()

    def read() -> int:
        return sum(len(next(endless)) for _ in range(batches))

    return read


def mcap_reader(frames: Frames, order: NDArray[np.int64], count: int) -> Read:
    """Return a `Read` of `count` images. The official `mcap` library seeks and reads each image,
    which is then decoded."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from mcap.reader import make_reader

    from datagen.recording.schema import topics

    ends = np.cumsum([info.frames for info in frames.rounds])
    readers = {info.path: make_reader(info.path.open("rb")) for info in frames.rounds}
    chosen = iter(order.tolist() * 100)

    def read() -> int:
        for _ in range(count):
            i = next(chosen)
            number = int(np.searchsorted(ends, i, side="right"))
            info = frames.rounds[number]
            time_ns = topics.log_time_ns(i - int(ends[number]) + info.frames, 20)
            found = readers[info.path].iter_messages(
                [topics.CAMERA], starting_at=time_ns, ending_at=time_ns
            )
            for _, _, message in found:
                simplejpeg.decode_jpeg(CompressedImage.FromString(message.data).data, "RGB")
        return count

    return read


def opening_ms(folder: Path) -> float:
    started = time.perf_counter()
    frames = Dataset.open(folder).select("all")
    assert len(frames)
    return 1e3 * (time.perf_counter() - started) * ROUNDS / len(frames.rounds)


def measure(folder: Path, repeats: int) -> dict[str, Any]:
    frames = Dataset.open(folder).select("all")
    order = np.random.default_rng(0).permutation(len(frames))
    ways: dict[str, Read] = {
        "decoder": decoder(frames, order),
        "ours": ours(frames, 100),
        "dataloader": dataloader(frames, 60),
        "mcap_reader": mcap_reader(frames, order, 100),
    }
    for file in (folder / "rounds").glob("*.mcap"):
        file.read_bytes()  # fills the page cache
    speeds: dict[str, list[float]] = {name: [] for name in ways}
    opened = []
    for number in range(repeats + 1):
        for name, read in ways.items():
            started = time.perf_counter()
            speed = read() / (time.perf_counter() - started)
            if number:  # the first repetition warms up
                speeds[name].append(speed)
        opened.append(opening_ms(folder))
    median = {name: statistics.median(found) for name, found in speeds.items()}
    over_dataloader = median["ours"] / median["dataloader"]
    over_mcap = median["ours"] / median["mcap_reader"]
    open_ms = statistics.median(opened)
    return {
        "frames": len(frames),
        "jpeg_bytes": round(float(np.mean([len(frames.jpeg(int(i))) for i in order[:500]]))),
        "cores": CORES,
        "images_per_second": {name: round(speed) for name, speed in median.items()},
        "best_images_per_second": {name: round(max(found)) for name, found in speeds.items()},
        "ours_to_decoder": round(median["ours"] / median["decoder"], 3),
        "ours_to_dataloader": round(over_dataloader, 2),
        "ours_to_mcap_reader": round(over_mcap, 2),
        "open_60_rounds_ms": round(open_ms, 1),
        "reached": {
            "images_per_second": median["ours"] >= LEAST_IMAGES_PER_SECOND,
            "dataloader": over_dataloader >= LEAST_OVER_DATALOADER,
            "mcap_reader": over_mcap >= LEAST_OVER_MCAP,
            "open": open_ms <= MOST_OPEN_MS,
        },
    }


def main(data: Path | None = None, repeats: int = 5, json: Path | None = None) -> None:
    with tempfile.TemporaryDirectory() as home:
        result = measure(data or enlarged_few(Path(home), ROUNDS, frames=250), repeats)
    conclude(result, json, all(result["reached"].values()))


if __name__ == "__main__":
    run_command(main)

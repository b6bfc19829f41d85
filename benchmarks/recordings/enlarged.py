"""Makes a dataset of any size from a few collected rounds: each new round repeats the frames of the
collected rounds.

The reason is time: collecting 120,000 frames takes minutes. For measuring the time of reading and
checking, only the number of frames and their bytes matter. Log times and state files are as in a
collected dataset.
"""

import hashlib
import json
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader

from datagen.recording.dataset import round_files
from datagen.recording.folder import RoundState, partial_path, prepare, publish
from datagen.recording.manifest import rebuild
from datagen.recording.mcap.index import open_round
from datagen.recording.mcap.writer import RoundFile
from datagen.recording.round_metadata import RESULT_METADATA, RoundHeader, RoundResult
from datagen.recording.schema import topics
from datagen.recording.schema.messages import timestamp
from datagen.recording.splits import Split

Steps = list[dict[str, bytes]]


def collect(folder: Path, **options: object) -> dict[str, Any]:
    """Run `datagen collect` with the options `options` into `folder`; return its JSON result."""
    command = [sys.executable, "-m", "datagen", "collect", "--json", "--out", str(folder)]
    for name, value in options.items():
        command += [f"--{name}", str(value)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def collect_few(folder: Path, rounds: int, frames: int) -> Path:
    """Collect a small training set of `rounds` rounds with `frames` frames each into `folder`.
    Every frame has another scenery. Return `folder`."""
    collect(folder, rounds=rounds, frames=frames, seed=11, stretch=1)
    return folder


def enlarged_few(home: Path, rounds: int, frames: int) -> Path:
    """Make a dataset of `rounds` rounds with `frames` frames each, from four collected rounds of
    150 frames.

    Returns the folder of the dataset, which is in `home`.
    """
    return enlarge(collect_few(home / "few", 4, 150), home / "data", rounds, frames)


def enlarge(source: Path, folder: Path, rounds: int, frames: int) -> Path:
    """Write `rounds` rounds of `frames` frames from the frames of `source`; return `folder`.

    A quarter of the rounds are test rounds.
    """
    prepare(folder)
    known = [(open_round(file).header, _steps(file)) for file in round_files(source)]
    for number in range(rounds):
        header, steps = known[number % len(known)]
        header = replace(header, id=f"r{number:03d}", seed=number)
        _write(folder, header, steps, first=17 * number + 1, frames=frames)
    ids = [f"r{number:03d}" for number in range(rounds)]
    test = tuple(ids[::4])
    rebuild(folder, Split(train=tuple(i for i in ids if i not in test), test=test))
    print(f"enlarged to {rounds} rounds of {frames} frames", file=sys.stderr)
    return folder


def _steps(file: Path) -> Steps:
    steps: dict[int, dict[str, bytes]] = defaultdict(dict)
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            steps[message.sequence][channel.topic] = message.data
    return [steps[number] for number in sorted(steps)]


def _write(folder: Path, header: RoundHeader, steps: Steps, first: int, frames: int) -> None:
    partial = partial_path(folder, header.id)
    content = hashlib.sha256()
    with RoundFile(partial, header) as file:
        for number in range(frames):
            step = steps[(first + number) % len(steps)]
            time = topics.log_time_ns(number, header.frequency_hz)
            for topic in topics.EVERY_STEP:
                data = step[topic]
                if topic == topics.CAMERA:
                    image = CompressedImage.FromString(data)
                    content.update(image.data)
                    image.timestamp.CopyFrom(timestamp(time))
                    data = image.SerializeToString()
                elif topic == topics.LABELS:
                    content.update(data)
                file.add(topic, time, number, data)
        result = RoundResult(frames, content.hexdigest())
        file.add_metadata(RESULT_METADATA, result.to_metadata())
        file.finish()
    publish(folder, partial, RoundState.of(partial, header, result))

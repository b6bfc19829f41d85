"""Simulates recorded rounds again from their plan and compares the result with the files.

datagen verify datasets/default --replay 3
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

import trackfeatures as tf
from datagen.execution.collect import PLAN_FILE
from datagen.planning.plan import RoundPlan, program
from datagen.recorder.record import open_simulation, simulate
from datagen.recording.dataset import IMAGE_DATA
from datagen.recording.errors import DatasetError
from datagen.recording.folder import read_states, round_path
from datagen.recording.images import encode
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.schema import messages, topics

OnReplayed = Callable[[str], None]
"""Called with the id of each replayed round."""


def replay(
    folder: Path,
    count: int,
    tracks_dir: Path | None = None,
    pixels: bool = False,
    on_replayed: OnReplayed = lambda name: None,
) -> tuple[list[str], list[str]]:
    """Simulate up to `count` rounds again, spread over the plan. Returns the ids of these rounds,
    and a line for each difference from the files. `on_replayed` is called with the id of each
    round.

    Labels and states must equal the recorded ones in every byte. With `pixels` the images must be
    equal too, which requires the renderer that drew the recorded images. Raises UserError if a
    round cannot be simulated on this machine.
    """
    if count < 1:
        raise tf.UserError(f"--replay is {count}; give the number of rounds to simulate again")
    entries = _spread(_recorded(folder), count)
    problems: list[str] = []
    for entry in entries:
        problems += differences(entry, round_path(folder, entry.id), tracks_dir, pixels)
        on_replayed(entry.id)
    return [entry.id for entry in entries], problems


def differences(
    entry: RoundPlan, path: Path, tracks_dir: Path | None, pixels: bool
) -> Iterator[str]:
    """Yield a line for each topic in which the recorded round at `path` differs from a new
    simulation of its plan entry. Images are compared only if `pixels` is true. Frames that a
    recovered round has lost are not compared. Raises DatasetError if the round is damaged."""
    index = open_round(path)
    recorded = {
        topic: {time: n for n, time in enumerate(index.log_times(topic).tolist())}
        for topic in (topics.LABELS, topics.EGO_STATE, topics.CAMERA)
    }
    first: dict[str, int] = {}
    number = 0
    with open_simulation(entry, tracks_dir) as (simulation, camera):
        for batch in simulate(simulation, camera):
            for truth in batch:
                simulated = {
                    topics.LABELS: messages.labels(truth.frame),
                    topics.EGO_STATE: messages.ego_state(truth.frame.ego),
                }
                if pixels:
                    simulated[topics.CAMERA] = encode(truth.render(camera), entry.codec)
                time = topics.log_time_ns(number, entry.frequency_hz)
                for topic, data in simulated.items():
                    place = recorded[topic].pop(time, None)
                    lost = place is None and index.recovery is not None
                    if not lost and (place is None or _payload(index, topic, place) != data):
                        first.setdefault(topic, number)
                number += 1
    for topic in (topics.LABELS, topics.EGO_STATE):
        if recorded[topic]:  # frames that were not simulated
            first.setdefault(topic, number)
    for topic, at in sorted(first.items()):
        yield (
            f"{path.name}: simulated again, {topic} differs from frame {at} on (recorded by "
            f"{index.header.program}, this is {program()})"
        )


def _payload(index: RoundIndex, topic: str, place: int) -> memoryview:
    """Return message number `place` of a topic; of an image, only the encoded image. Raises
    DatasetError if the message is damaged."""
    try:
        payload = index.messages[topic].payload(place)
        return bytes_field(payload, IMAGE_DATA) if topic == topics.CAMERA else payload
    except ValueError as error:
        raise DatasetError(
            f"{index.path}: message {place} on {topic} cannot be read ({error}); run `datagen "
            "verify` on the dataset and record the round again"
        ) from error


def _recorded(folder: Path) -> list[RoundPlan]:
    """Plan entries of the recorded rounds. Raises DatasetError without a plan of the scripted
    driver."""
    path = folder / PLAN_FILE
    states = read_states(folder)
    try:
        plan = json.loads(path.read_text())
        if "driver" in plan:
            raise DatasetError(
                f"{folder} was driven by {', '.join(plan['driver'].values())}, not by the scripted "
                "driver; only rounds of `datagen collect` can be simulated again"
            )
        entries = plan["rounds"]
        return [RoundPlan.from_json(entry) for entry in entries if entry["id"] in states]
    except FileNotFoundError as error:
        raise DatasetError(
            f"there is no {path}: only a dataset with a plan can be replayed"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is not a plan of this version ({error!r})") from error


def _spread(entries: Sequence[RoundPlan], count: int) -> list[RoundPlan]:
    if len(entries) <= count:
        return list(entries)
    return [entries[int(i)] for i in np.linspace(0, len(entries) - 1, count)]

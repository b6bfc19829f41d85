"""Recovers a damaged round file: writes its intact frames as a new round, marked as recovered.

A frame is intact if all its messages are intact: the image, the label and all other messages of
this frame.
"""

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import trackfeatures as tf
from datagen.recording.dataset import IMAGE_DATA
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    RoundState,
    discard_partials,
    partial_path,
    state_path,
    write_state,
)
from datagen.recording.integrity.round_checks import check_round
from datagen.recording.mcap.fragments import (
    FoundMessage,
    chunk_messages,
    find_chunks,
    find_metadata,
)
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.mcap.records import MAGIC
from datagen.recording.mcap.writer import RoundFile
from datagen.recording.round_metadata import (
    RECOVERY_METADATA,
    RESULT_METADATA,
    ROUND_METADATA,
    Recovery,
    RoundHeader,
    RoundResult,
)
from datagen.recording.schema import messages, topics
from runtime.files import atomic_move, unfinished_path

ROUNDS = "rounds"

Step = dict[str, FoundMessage]


@dataclass(frozen=True, slots=True)
class IntactFrames:
    """`steps`: the messages of each intact frame by topic, by frame number in ascending order.
    `scene`: the message with the lines of the track; None if it is damaged."""

    steps: dict[int, Step]
    scene: FoundMessage | None


@dataclass(frozen=True, slots=True)
class Recovered:
    """The result of `datagen recover`: numbers of saved and lost frames. If `at_least` is true,
    `lost` is a lower limit. The fields are the keys of `--json`."""

    out: str
    saved: int
    lost: int
    at_least: bool


def recover(file: Path, out: Path | None = None) -> Recovered:
    """Write the intact frames of `file` to `out` (default: `default_out`); `file` is kept.

    If `out` is in `rounds/` of a dataset, it becomes a round of the dataset, marked as recovered.
    Raises DatasetError if nothing can be saved or `out` cannot be used, and OSError.
    """
    file = file.absolute()  # the names of its folders decide whether it is in a dataset
    target = default_out(file) if out is None else out.absolute()
    data = file.read_bytes()
    header = _header(file, data)
    in_dataset = target.parent.name == ROUNDS and (target.parent.parent / "state").is_dir()
    _require_free(target, header.id if in_dataset else "")
    intact = find_intact_frames(data, header.frequency_hz)
    if not intact.steps:
        raise DatasetError(f"{file} holds no intact frame: there is nothing to save")
    recovery = _recovery(file, data, intact)
    folder = target.parent.parent
    if in_dataset:
        partial = partial_path(folder, header.id)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = unfinished_path(target)
    try:
        state = _write(partial, header, intact, recovery)
        if in_dataset:
            # The state is written first: readers look for the round file, which must come last.
            write_state(folder, state)
        atomic_move(partial, target)
    finally:
        partial.unlink(missing_ok=True)
        if in_dataset:
            discard_partials(folder, [header.id])
    return Recovered(str(target), recovery.saved, recovery.lost, recovery.at_least)


def default_out(file: Path) -> Path:
    """Return the default path of the recovered round: beside `file`, or in `recovered/` of the
    dataset if `file`, an absolute path, is one of its rounds."""
    if file.parent.name == ROUNDS:
        return file.parent.parent / "recovered" / file.name
    return file.with_name(f"{file.stem}.recovered.mcap")


def find_intact_frames(data: bytes, frequency_hz: int) -> IntactFrames:
    """Find all intact frames in `data`, the bytes of a round file with `frequency_hz` frames per
    second, before and after the damage."""
    steps: dict[int, Step] = defaultdict(dict)
    scene = None
    for chunk in find_chunks(data):
        for message in chunk_messages(chunk):
            if message.topic == topics.TRACK_SCENE:
                scene = scene or message
            elif message.log_time == topics.log_time_ns(message.step, frequency_hz):
                steps[message.step].setdefault(message.topic, message)
    intact = {n: steps[n] for n in sorted(steps) if all(t in steps[n] for t in topics.EVERY_STEP)}
    return IntactFrames(intact, scene)


def _header(file: Path, data: bytes) -> RoundHeader:
    found = find_metadata(data, ROUND_METADATA) if data.startswith(MAGIC) else None
    try:
        if found is None:
            raise ValueError(
                "its first bytes, with the header of the round, are damaged or of another format"
            )
        header = RoundHeader.from_metadata(found)
        header.validate()
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{file} cannot be recovered ({error}); record the round again"
        ) from error
    tf.require_version(header.definitions, str(file))
    return header


def _require_free(target: Path, round_id: str) -> None:
    if target.exists():
        raise DatasetError(f"{target} exists; nothing was changed; choose another --out")
    if round_id and target.stem != round_id:
        raise DatasetError(
            f"the file name of a round must be its id: expected {round_id}.mcap, --out is {target}"
        )


def _recovery(file: Path, data: bytes, intact: IntactFrames) -> Recovery:
    """Make the recovery record of the damaged `file` with the bytes `data` and the frames `intact`.
    The original number of frames is read from the result metadata or, if they are damaged, from the
    state of the round. Frames that `file` lacks because it was recovered itself are lost, too."""
    saved = len(intact.steps)
    recorded = _recorded_frames(data)
    if not recorded and file.parent.name == ROUNDS:
        state = state_path(file.parent.parent, file.stem)
        recorded = RoundState.read(state).frames if state.is_file() else 0
    known = recorded >= saved
    total = recorded if known else max(intact.steps) + 1
    lost, earlier = total - saved, _earlier_recovery(data)
    if earlier is None:
        return Recovery(file.name, saved, lost, at_least=not known)
    # `total` is the number of frames after the earlier recovery or, if this number is not known,
    # follows from the highest frame number, which counts the frames lost in between.
    lost = lost + earlier.lost if known else max(lost, earlier.lost)
    return Recovery(file.name, saved, lost, at_least=not known or earlier.at_least)


def _earlier_recovery(data: bytes) -> Recovery | None:
    """Return the record of the recovery that wrote `data`; None if there is none or it is
    damaged."""
    found = find_metadata(data, RECOVERY_METADATA)
    try:
        return None if found is None else Recovery.from_metadata(found)
    except (ValueError, TypeError):
        return None


def _recorded_frames(data: bytes) -> int:
    found = find_metadata(data, RESULT_METADATA)
    try:
        return 0 if found is None else RoundResult.from_metadata(found).frames
    except (ValueError, TypeError):
        return 0


def _write(path: Path, header: RoundHeader, intact: IntactFrames, recovery: Recovery) -> RoundState:
    """Write the intact frames as a round file at `path`, with their original log times and the
    metadata records `header` and `recovery`. Return the state of the new file."""
    content = hashlib.sha256()
    with RoundFile(path, header) as file:
        for topic, log_time, number, payload in _messages(header, intact):
            file.add(topic, log_time, number, payload)
            if topic == topics.CAMERA:
                content.update(bytes_field(payload, IMAGE_DATA))
            elif topic == topics.LABELS:
                content.update(payload)
        result = RoundResult(len(intact.steps), content.hexdigest())
        file.add_metadata(RECOVERY_METADATA, recovery.to_metadata())
        file.add_metadata(RESULT_METADATA, result.to_metadata())
        file.finish()
    state = RoundState.of(path, header, result)
    _, problems = check_round(path, "full", state)
    if problems:
        raise DatasetError(f"the recovered round cannot be read back: {problems[0]}")
    return state


def _messages(
    header: RoundHeader, intact: IntactFrames
) -> Iterator[tuple[str, int, int, memoryview]]:
    first = min(intact.steps)
    time = topics.log_time_ns(first, header.frequency_hz)
    if intact.scene is not None:
        yield topics.TRACK_SCENE, time, first, intact.scene.payload
    if topics.CALIBRATION not in intact.steps[first]:
        calibration = messages.calibration(header.camera, messages.timestamp(time))
        yield topics.CALIBRATION, time, first, memoryview(calibration)
    for number, step in intact.steps.items():
        for topic in (topics.CALIBRATION, *topics.EVERY_STEP):
            if topic in step:
                yield topic, step[topic].log_time, number, step[topic].payload

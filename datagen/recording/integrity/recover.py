"""Saving what is whole in a damaged round file: a new round, readable, indexed, and marked as such.

A frame is whole when all its messages are: the image, its label and what was recorded with them.
"""

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.recording.dataset import IMAGE_DATA
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    RoundState,
    file_sha256,
    partial_path,
    publish,
    state_path,
)
from datagen.recording.integrity.round_checks import check_round
from datagen.recording.mcap.fragments import Fragment, fragments, metadata, pieces
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

Step = dict[str, Fragment]


@dataclass(frozen=True, slots=True)
class Whole:
    """The frames all of whose messages were found, by number, in order; the track where it was."""

    steps: dict[int, Step]
    scene: Fragment | None


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was saved, and where it is."""

    out: str
    saved: int
    lost: int
    at_least: bool

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def recover(file: Path, out: Path | None = None) -> Recovered:
    """Write what is whole in `file` to `out`, or to where `default_out` says; `file` stays.

    Written into the `rounds/` of a dataset it becomes a round of it, still marked as recovered.
    Raises DatasetError when nothing can be saved or `out` cannot be, OSError as it comes.
    """
    target = default_out(file) if out is None else out
    data = file.read_bytes()
    header = _header(file, data)
    in_dataset = target.parent.name == ROUNDS and (target.parent.parent / "state").is_dir()
    _require_free(target, header.id if in_dataset else "")
    whole = find_whole(data, header.frequency_hz)
    if not whole.steps:
        raise DatasetError(f"{file} holds no whole frame: there is nothing to save")
    recovery = _recovery(file, data, whole)
    folder = target.parent.parent
    if in_dataset:
        partial = partial_path(folder, header.id)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = unfinished_path(target)
    try:
        state = _write(partial, header, whole, recovery)
        if in_dataset:
            publish(folder, partial, state)
        else:
            atomic_move(partial, target)
    finally:
        partial.unlink(missing_ok=True)
    return Recovered(str(target), recovery.saved, recovery.lost, recovery.at_least)


def default_out(file: Path) -> Path:
    """Beside the file; out of the way of a dataset's rounds."""
    if file.parent.name == ROUNDS:
        return file.parent.parent / "recovered" / file.name
    return file.with_name(f"{file.stem}.recovered.mcap")


def find_whole(data: bytes, frequency_hz: int) -> Whole:
    """Every frame that is whole, on either side of the damage."""
    steps: dict[int, Step] = defaultdict(dict)
    scene = None
    for piece in pieces(data):
        for fragment in fragments(piece):
            if fragment.topic == topics.TRACK_SCENE:
                scene = scene or fragment
            elif fragment.log_time == topics.log_time_ns(fragment.step, frequency_hz):
                steps[fragment.step].setdefault(fragment.topic, fragment)
    whole = {n: steps[n] for n in sorted(steps) if all(t in steps[n] for t in topics.EVERY_STEP)}
    return Whole(whole, scene)


def _header(file: Path, data: bytes) -> RoundHeader:
    found = metadata(data, ROUND_METADATA) if data.startswith(MAGIC) else None
    try:
        if found is None:
            raise ValueError("its first bytes, which say what round it is, are not those of one")
        header = RoundHeader.from_metadata(found)
        header.require_sane()
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
            f"a round of a dataset bears the name of its id: expected {round_id}.mcap, "
            f"--out is {target}"
        )


def _recovery(file: Path, data: bytes, whole: Whole) -> Recovery:
    """How many frames there were is in the file's end, or in the state file beside it."""
    saved = len(whole.steps)
    recorded = _recorded(data)
    if not recorded and file.parent.name == ROUNDS:
        state = state_path(file.parent.parent, file.stem)
        recorded = RoundState.read(state).frames if state.is_file() else 0
    known = recorded >= saved
    total = recorded if known else max(whole.steps) + 1
    return Recovery(file.name, saved, total - saved, at_least=not known)


def _recorded(data: bytes) -> int:
    found = metadata(data, RESULT_METADATA)
    try:
        return 0 if found is None else RoundResult.from_metadata(found).frames
    except (ValueError, TypeError):
        return 0


def _write(path: Path, header: RoundHeader, whole: Whole, recovery: Recovery) -> RoundState:
    """The round as `RoundWriter` would have written it, with the gaps that the damage left."""
    content = hashlib.sha256()
    with RoundFile(path, header) as file:
        for topic, log_time, number, payload in _messages(header, whole):
            file.add(topic, log_time, number, payload)
            if topic == topics.CAMERA:
                content.update(bytes_field(payload, IMAGE_DATA))
            elif topic == topics.LABELS:
                content.update(payload)
        result = RoundResult(len(whole.steps), content.hexdigest())
        file.add_metadata(RECOVERY_METADATA, recovery.to_metadata())
        file.add_metadata(RESULT_METADATA, result.to_metadata())
        file.finish()
    state = RoundState(
        id=header.id,
        file=f"{ROUNDS}/{header.id}.mcap",
        bytes=path.stat().st_size,
        sha256=file_sha256(path),
        frames=result.frames,
        content_hash=result.content_hash,
        definitions=header.definitions,
    )
    _, problems = check_round(path, "full", state)
    if problems:
        raise DatasetError(f"what was saved cannot be read back: {problems[0]}")
    return state


def _messages(header: RoundHeader, whole: Whole) -> Iterator[tuple[str, int, int, memoryview]]:
    first = min(whole.steps)
    time = topics.log_time_ns(first, header.frequency_hz)
    if whole.scene is not None:
        yield topics.TRACK_SCENE, time, first, whole.scene.payload
    if topics.CALIBRATION not in whole.steps[first]:
        own = messages.calibration(header.camera, messages.timestamp(time))
        yield topics.CALIBRATION, time, first, memoryview(own)
    for number, step in whole.steps.items():
        for topic in (topics.CALIBRATION, *topics.EVERY_STEP):
            if topic in step:
                yield topic, step[topic].log_time, number, step[topic].payload

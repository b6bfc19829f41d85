"""Predicts the features of the images of any source and writes them, for `mtlnet predict`.

Three threads share the work: one decodes, one runs the network, one draws and writes. Each thread
keeps the order of the images, so that answers and files do not depend on timing.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any, Self

from mtlnet.inference.engine import Engine
from mtlnet.inference.prediction import Prediction, decode_outputs
from mtlnet.predict.lenses import with_lens
from mtlnet.predict.writers import Writer, check_outputs, open_writer, require_inputs_kept
from mtlnet.sources.find import DEFAULT_FPS, Note, Source, find_sources
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.pictures import Lens
from mtlnet.sources.read import READ_AHEAD, SourceImage, read_sources
from mtlnet.sources.streams import Stream
from runtime.cli import counted
from trackfeatures.errors import UserError

KEPT_ROWS = 10_000
"""Maximum number of results that `predict_files` returns; all results are written to files."""


class InputsLeftOut(UserError):
    """Raised when some inputs or images could not be used; `results` has the results of the other
    images, at most the first 10,000."""

    def __init__(self, message: str, results: list[dict[str, Any]]) -> None:
        super().__init__(message)
        self.results = results


def predict_files(
    engine: Engine,
    inputs: Sequence[str],
    outputs: Sequence[Path] = (),
    lens: Lens = None,
    report: Callable[[int, int], None] = lambda done, total: None,
    note: Note = lambda line: None,
    topic: str = "",
    *,
    calibrate: bool = False,
    stated: bool = True,
) -> list[dict[str, Any]]:
    """Predict the features of all images that `inputs` name (`mtlnet.sources.find.find_sources`).

    Returns the results of the first 10,000 images, a dict for each; all results are written to each
    of `outputs` (`mtlnet.predict.writers.open_writer`), image by image. The outputs are opened when
    the first image has been answered; earlier files are kept if no image can be used. `lens`: the
    lens of all sources except recorded rounds, which must be of the model's camera; None: the lens
    that a recording states (with `stated`) or that is estimated, else the model's. `report`: called
    with the numbers of images done and in total. `note`: called with a line about files left out
    and cameras found. `topic`: topic to read from recordings; empty: the only topic with pictures.
    `calibrate`: estimate the camera of films and streams from their pictures. Ctrl-C ends a stream;
    before the first stream begins, it raises KeyboardInterrupt.

    Raises InputsLeftOut, after all other images are done, when an input or an image could not be
    used; UserError at once for an invalid `lens`, and for outputs that cannot be written, are
    the same file, are among the files to read or could replace one of them.
    """
    if isinstance(lens, float | int) and not 0 < lens < 180:  # NaN too
        raise UserError(f"--fov-y-deg {lens:g}: a field of view is above 0 and below 180 degrees")
    camera = engine.card.camera
    check_outputs(outputs)
    sources = find_sources(list(inputs), note, topic)
    usable = [source for source in sources if not source.problem]
    require_inputs_kept(outputs, (file for source in sources for file in source.files))
    _note_unread(sources, note)
    sources = [
        with_lens(s, camera, lens, note, calibrate=calibrate, stated=stated) for s in sources
    ]
    before_streams = _images_before_streams(usable)
    answers = _Answers(engine, sum(source.count for source in sources), report)
    fps = usable[0].fps if usable else DEFAULT_FPS

    def open_files() -> list[Writer]:
        return [files.enter_context(open_writer(path, camera, fps)) for path in outputs]

    with (
        ExitStack() as files,
        _Writing(open_files) as writing,
        closing(read_sources(sources, camera)) as items,
    ):
        try:
            for item in items:
                answers.add(item, writing)
        except KeyboardInterrupt:
            if answers.used < before_streams:
                raise
            note(f"stopped after {answers.used} images")
    _report_streams(sources, answers, note)
    return answers.finish(note, written=bool(outputs))


def _note_unread(sources: Sequence[Source], note: Note) -> None:
    """Note the sources that are left out, and the streams that wait until another has ended."""
    for source in sources:
        if source.problem and len(sources) > 1:  # the problem of a single source is the error
            note(source.problem)
    live = [s.name for s in sources if s.kind is SourceKind.STREAM and not s.problem]
    for before, later in pairwise(live):
        note(f"{later} is read when {before} has ended; to read both now, use two commands")


def _images_before_streams(sources: Sequence[Source]) -> float:
    """Return the number of images before the first stream, infinite without a stream."""
    before = list(takewhile(lambda source: source.kind is not SourceKind.STREAM, sources))
    return sum(source.count for source in before) if len(before) < len(sources) else math.inf


def _report_streams(sources: Sequence[Source], answers: "_Answers", note: Note) -> None:
    """Report the end of each stream, and the damage of a stream that Ctrl-C has ended."""
    for source in sources:
        stream = source.opened
        if not isinstance(stream, Stream):
            continue
        if stream.note:
            note(stream.note)
        elif stream.fault:
            answers.fail(stream.fault)
        elif stream.damaged:
            answers.fail(f"{stream.name}: {stream.damage()}")


def answer(engine: Engine, item: SourceImage) -> Prediction:
    """Run `engine` on an image that could be read, and return its features, with distances in
    metres at the image's own camera."""
    assert item.image is not None
    outputs = engine(item.image)
    if item.lens is not None:
        outputs = item.lens.outputs(outputs[None])[0]
    return decode_outputs(outputs)


def first_of(errors: list[str]) -> str:
    """Return the first of `errors` and the number of the remaining errors, as one text."""
    return f"{errors[0]} (and {len(errors) - 1} more)" if len(errors) > 1 else errors[0]


class _Answers:
    """Runs the engine on images; collects the results, and the errors of unusable images."""

    def __init__(self, engine: Engine, total: int, report: Callable[[int, int], None]) -> None:
        self._engine, self._total, self._report = engine, total, report
        self._done = self.used = 0
        self._results: list[dict[str, Any]] = []
        self._unusable: list[str] = []

    def add(self, item: SourceImage, writing: "_Writing") -> None:
        self._done += 1
        self._report(self._done, max(self._total, self._done))
        if item.image is None:
            self._unusable.append(item.error)
            return
        begin = time.perf_counter()
        prediction = answer(self._engine, item)
        latency_ms = round(1e3 * (time.perf_counter() - begin), 3)
        writing.write(item, prediction)
        self.used += 1
        if len(self._results) < KEPT_ROWS:
            about = {"model": self._engine.card.name, "latency_ms": latency_ms}
            row = {"image": item.name, "time_s": item.time_s, **prediction.as_json(), **about}
            self._results.append(row)

    def fail(self, error: str) -> None:
        """Add an error, unless the item that reports it has been added."""
        if error not in self._unusable:
            self._unusable.append(error)

    def finish(self, note: Note, *, written: bool) -> list[dict[str, Any]]:
        """The results of the first `KEPT_ROWS` images; notes if there are more, unless all results
        have been `written` to an output. Raises InputsLeftOut when an image could not
        be used."""
        if self.used > KEPT_ROWS and not written:
            note(f"{self.used} images done, the result has the first {KEPT_ROWS}; --out has all")
        if not self._unusable:
            return self._results
        others = f"; {counted(self.used, 'image')} done" if self.used else ""
        raise InputsLeftOut(f"{first_of(self._unusable)}{others}", self._results)


class _Writing:
    """Writes answers in order on its own thread.

    The first `write` opens the writers, so that files of an earlier command are kept if no image
    can be used. The next `write`, or the end of the context, raises an error that occurred in this
    thread; nothing is written after the error.
    """

    def __init__(self, open_writers: Callable[[], list[Writer]]) -> None:
        self._open_writers = open_writers
        self._writers: list[Writer] | None = None
        self._thread = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()
        self._failed = False

    def write(self, item: SourceImage, prediction: Prediction) -> None:
        """Queue one answer for writing; waits while more than `READ_AHEAD` answers are queued."""
        if self._writers is None:
            self._writers = self._open_writers()
        if self._writers:
            self._waiting.append(self._thread.submit(self._write, item, prediction))
        while self._waiting and (len(self._waiting) > READ_AHEAD or self._waiting[0].done()):
            self._waiting.popleft().result()

    def _write(self, item: SourceImage, prediction: Prediction) -> None:
        if self._failed:
            return
        try:
            for writer in self._writers or ():
                writer.write(item, prediction)
        except BaseException:
            self._failed = True
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._thread.shutdown()
        while self._waiting and kind is None:
            self._waiting.popleft().result()

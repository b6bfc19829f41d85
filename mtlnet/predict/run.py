"""`mtlnet predict`: the features of images, films and recorded rounds, yielded and written."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mtlnet.inference.engine import Engine
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.sources import DEFAULT_FPS, Lens, Note, find_sources, read_sources
from mtlnet.predict.writers import open_writer, require_other_file
from trackfeatures.errors import UserError

KEPT_ROWS = 10_000
"""Results returned at most; files get all."""


class InputsLeftOut(UserError):
    """Inputs or images that could not be used; `results` are those of all others."""

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
) -> list[dict[str, Any]]:
    """The features of all images that `inputs` name (`mtlnet.predict.sources.find_sources`).

    Those of the first `KEPT_ROWS` are returned, all are written to each of `outputs`
    (`mtlnet.predict.writers.open_writer`), one image at a time. `lens`: of images and films; a
    recorded round must be of the model's camera. `report`: takes the numbers of images done and in
    all. `note`: takes a line on what is left out, before the first image. Raises InputsLeftOut,
    after all others were done, when an input or an image could not be used; UserError at once for
    outputs that cannot be written or are among the files to read, or an impossible `lens`.
    """
    if isinstance(lens, float | int) and not 0 < lens < 180:  # NaN too
        raise UserError(f"--fov-y-deg {lens:g}: a field of view is above 0 and below 180 degrees")
    sources = find_sources(list(inputs), note)
    other = lens if isinstance(lens, Rectification) else None
    camera, name = engine.card.camera, engine.card.name
    total = sum(source.count for source in sources)
    drawn = camera if other is None else other.view
    results: list[dict[str, Any]] = []
    unusable: list[str] = []
    used = 0
    for path in outputs:
        require_other_file(path, [source.path for source in sources if not source.problem])
    for source in sources:
        if source.problem:
            note(source.problem)
    with ExitStack() as stack:
        fps = next((source.fps for source in sources if not source.problem), DEFAULT_FPS)
        writers = [stack.enter_context(open_writer(path, drawn, fps)) for path in outputs]
        for done, item in enumerate(read_sources(sources, camera, lens), start=1):
            report(done, max(total, done))
            if item.image is None:
                unusable.append(item.error)
                continue
            begin = time.perf_counter()
            answers = engine(item.image)
            if other is not None:
                answers = other.outputs(answers[None])[0]
            prediction = decode_outputs(answers)
            latency_ms = round(1e3 * (time.perf_counter() - begin), 3)
            for writer in writers:
                writer.write(item, prediction)
            used += 1
            if len(results) < KEPT_ROWS:
                about = {"model": name, "latency_ms": latency_ms}
                results.append({"image": item.name, **prediction.as_json(), **about})
    if unusable:
        more = f" (and {len(unusable) - 1} more)" if len(unusable) > 1 else ""
        others = f"; {used} others were done" if used else ""
        raise InputsLeftOut(f"{unusable[0]}{more}{others}", results)
    return results

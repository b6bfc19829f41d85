"""Evaluates a model on rounds of a dataset, or on a user's own labelled pictures: `mtlnet evaluate
--model RUN --data DIR --json`."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames, UndecodableImage
from datagen.recording.manifest import MANIFEST
from datagen.recording.splits import split_path
from mtlnet.data.custom_images import files_to_read, has_labels_file, open_custom_images
from mtlnet.data.labels_file import LABELS
from mtlnet.data.loader import Images
from mtlnet.data.model_labels import car_outputs
from mtlnet.data.picture_copies import PLAIN, parse_copies
from mtlnet.data.rounds import require_camera, require_decodable
from mtlnet.evaluation.html_report import page_file, write_page, write_worst_sheet
from mtlnet.evaluation.metrics import evaluate_by_groups
from mtlnet.evaluation.picture_page import write_picture_page
from mtlnet.evaluation.pictures import judge, picture_report
from mtlnet.inference.engine import Engine, ViewAverage
from mtlnet.inference.model_card import ModelCard, ModelError
from mtlnet.inference.trained_rounds import Seeds
from runtime.files import check_folder, require_other_file
from trackfeatures.errors import UserError

CHUNK = 32  # frames per task of a thread


def evaluate(
    engines: Sequence[Engine],
    data: Path,
    split: str,
    report: Callable[[int, int], None] = lambda *_: None,
    page: Path | None = None,
    every: int = 1,
    worst: Path | None = None,
    copies: str = "",
) -> dict[str, Any]:
    """Evaluate a model on one split of a dataset; returns the report for all frames and by group
    (`mtlnet.evaluation.metrics`).

    `engines`: the same model, loaded once for each thread. `data`: folder of a dataset, or of a
    user's own pictures, which have no splits. `split`: train, test, unseen or all. `report(done,
    total)` is called with numbers of frames after every 32 frames. `page`: an HTML file to write,
    or its folder; `worst`: a JPEG to write of the frames with the largest errors. `every`: evaluate
    every n-th frame only, because consecutive frames are similar. `copies`: value of `--copies`,
    for a user's own pictures. Raises UserError when the data do not fit the model.
    """
    if every < 1:
        raise UserError(f"--every is {every}; give 1 for all frames, 5 for every fifth")
    if page is not None:
        page = page_file(page)
    engine = engines[0]
    if has_labels_file(data):
        _require_options_of_pictures(split, worst)
        return evaluate_custom_images(engines, data, report, every, parse_copies(copies), page)
    if copies:
        raise UserError(f"--copies is for pictures with a {LABELS}; {data} holds recorded rounds")
    dataset = Dataset.open(data)
    read = [data / MANIFEST, split_path(data), *(info.path for info in dataset.rounds)]
    _require_writable(page, worst, read)
    frames = dataset.select(split).every(every)
    require_fit(engine.card, frames, split)
    outputs = predict_rounds(engines, frames, data, report)
    mean = engine.card.data["mean"]
    found = {
        **about(engine),
        "data": str(data),
        "split": split,
        "every": every,
        "rounds": len(frames.rounds),
        **evaluate_by_groups(outputs, frames, mean),
    }
    if page is not None:
        found["page"] = str(write_page(page, found, frames, outputs))
    if worst is not None:
        write_worst_sheet(worst, frames, outputs)
    return found


def _require_options_of_pictures(split: str, worst: Path | None) -> None:
    """Raise UserError for options that are only for recorded rounds."""
    if worst is not None:
        raise UserError(
            "--worst shows recorded rounds; --report shows all pictures of your own, failures first"
        )
    if split not in ("test", "all"):  # "test" is the default
        raise UserError(
            f"--split {split} is for recorded rounds; all pictures of your own are evaluated"
        )


def _require_writable(page: Path | None, worst: Path | None, inputs: Sequence[Path]) -> None:
    """Raise UserError, before the long computation, if an output cannot be written, is one of the
    `inputs`, or is the other output."""
    for option, path in (("--report", page), ("--worst", worst)):
        if path is not None:
            check_folder(path)
            require_other_file(path, inputs, option)
    if page is not None and worst is not None and page.resolve() == worst.resolve():
        raise UserError(f"--report and --worst are the same file, {page}; give another one")


def evaluate_custom_images(
    engines: Sequence[Engine],
    folder: Path,
    report: Callable[[int, int], None] = lambda *_: None,
    every: int = 1,
    copies: Sequence[str] = (PLAIN,),
    page: Path | None = None,
) -> dict[str, Any]:
    """Evaluate a model on a user's own pictures with a `labels.csv`; returns the report
    (`mtlnet.evaluation.pictures`).

    `report(done, total)` is called with numbers of pictures. `every`: evaluate every n-th picture
    only, with its copies. `copies`: kinds of copies of each picture to evaluate, from
    `mtlnet.data.picture_copies.COPIES`. `page`: an HTML file to write. For pictures that show too
    little of the model's view, the report has the number but no errors. Raises UserError for faulty
    files.
    """
    if page is not None:
        _require_writable(page, None, files_to_read(folder))
    engine = engines[0]
    images = open_custom_images(folder, engine.card.camera, copies, every=every, skip_refused=True)
    trained = engine.card.data.get("pictures", ())
    answers = judge(images, predict_frames(engines, images, report), trained)
    found = {
        **about(engine),
        "data": str(folder),
        "split": "all",
        "every": every,
        "rounds": 0,
        **picture_report(answers, engine.card.data["mean"]),
    }
    if page is not None:
        found["page"] = str(write_picture_page(page, found, answers))
    return found


def about(engine: Engine) -> dict[str, Any]:
    """Return the entries of a report that describe the model: its name, the hash of its weights,
    the engine, the precision, and the number of views of each image whose answers are averaged."""
    return {
        "model": engine.card.name,
        "model_hash": engine.card.model_hash,
        "engine": engine.kind,
        "precision": engine.precision,
        "views": engine.views.count if isinstance(engine, ViewAverage) else 1,
    }


def predict_rounds(
    engines: Sequence[Engine], frames: Frames, data: Path, report: Callable[[int, int], None]
) -> NDArray[np.float32]:
    """Run the model on recorded rounds; returns outputs (N, K; columns: `split_outputs`), corrected
    for rounds whose camera is mounted at another position than the model's camera.

    `data`: the dataset's folder, for messages; `report(done, total)` is called with numbers of
    frames. Raises DatasetError, with the names of the first undecodable images, if there are any.
    """
    try:
        return car_outputs(predict_frames(engines, frames, report), frames)
    except UndecodableImage:
        require_decodable(frames, data)
        raise


def predict_frames(
    engines: Sequence[Engine],
    frames: Images,
    report: Callable[[int, int], None] = lambda *_: None,
) -> NDArray[np.float32]:
    """Run the model on all frames, with one thread per engine; returns outputs (N, K; columns:
    `split_outputs`).

    An engine computes one frame at a time, as in the service; on a GPU it computes 32 frames at
    once. `report(done, total)` is called after every 32 frames.
    """
    idle: SimpleQueue[tuple[Engine, NDArray[np.uint8]]] = SimpleQueue()
    for engine in engines:
        camera = engine.card.camera
        idle.put((engine, np.empty((CHUNK, camera.height, camera.width, 3), np.uint8)))

    def predict(first: int) -> list[NDArray[np.float32]]:
        engine, images = idle.get()
        rows = np.arange(first, min(first + CHUNK, len(frames)))
        try:
            found = frames.read_batch(rows, images[: len(rows)])
            if getattr(engine, "on_gpu", False):
                return list(engine.batch(found))  # type: ignore[attr-defined]  # the torch engine
            return [engine(image) for image in found]
        finally:
            idle.put((engine, images))

    outputs: list[NDArray[np.float32]] = []
    with ThreadPoolExecutor(len(engines), thread_name_prefix="engine") as pool:
        for found in pool.map(predict, range(0, len(frames), CHUNK)):
            outputs += found
            report(len(outputs), len(frames))
    return np.stack(outputs)


def require_fit(card: ModelCard, frames: Frames, split: str) -> None:
    """Raise ModelError when the frames' camera differs from the model's camera, or when the card
    does not describe the training data.

    For the splits test and unseen, ModelError is also raised when the model was trained on one of
    the rounds of `frames`; for unseen, also when it was trained on one of their tracks.
    """
    require_camera(card, frames.camera)
    if "mean" not in card.data:
        raise ModelError(
            f"model {card.name} has no description of its training data; train a new one"
        )
    if split not in ("test", "unseen"):
        return
    trained = Seeds.read(card.data["seeds"])
    seen = [info.seed for info in frames.rounds if info.seed in trained]
    if seen:
        raise ModelError(
            f"model {card.name} was trained on the round of seed {min(seen)}, a {split} round of "
            "this data; it cannot be tested on it: use --split all, or other rounds"
        )
    known = {info.track for info in frames.rounds} & set(card.data.get("tracks", ()))
    if split == "unseen" and known:
        raise ModelError(
            f"model {card.name} was trained on track {min(known)}, which is not unseen to it; "
            "collect another with `datagen collect --split unseen --tracks NAME`"
        )

"""The paper's ablation: single tasks, the task weightings MTL 1 to 4, DeepDriving and a torchvision
backbone.

Each row of the table is a network with task weights. It is trained once per seed, with equal
iterations on the same data, and evaluated on the same rounds in float32. Each training writes a run
folder, like `mtlnet train`. Finished runs are kept, so that an interrupted ablation continues with
the first unfinished run.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.ablation.config import AblationConfig
from mtlnet.architecture import find_architecture
from mtlnet.inference.curves import CURVES, read_curves
from mtlnet.inference.model_card import CARD, read_card
from mtlnet.training.checkpoint import FOLDER as CHECKPOINTS
from mtlnet.training.config import CONFIG, TrainConfig
from mtlnet.training.configure import resume_config
from mtlnet.training.losses.task_weights import Alpha
from runtime.files import atomic_write, write_json
from trackfeatures.errors import UserError

SETTINGS, EVALUATION = "settings.json", "evaluation.json"
BACKBONE = "mobilenet_v3_small"
TASK_NAMES = ("distance", "angle", "type")
"""Names of the tasks in the paper, in `PAPER_ROWS` and in the columns of `curves.csv`; the task
`type` is the class of the road."""


@dataclass(frozen=True)
class Row:
    """One row of the table: a network with task weights `alpha`.

    `paper`: the distance loss, the angle loss and the accuracy of the class (0 to 1) that the paper
    states for this row; None where the paper states no value.
    """

    name: str
    title: str
    network: str
    alpha: Alpha
    paper: tuple[float | None, float | None, float | None] = (None, None, None)


# Table "Multi-task Learning Test Loss with Various Settings" of the paper.
PAPER_ROWS = (
    Row("distance", "Distance alone", "mtl", (1.0, 0.0, 0.0), (0.06771, None, None)),
    Row("angle", "Angle alone", "mtl", (0.0, 1.0, 0.0), (None, 0.01304, None)),
    Row("type", "Type alone", "mtl", (0.0, 0.0, 1.0), (None, None, 0.9924)),
    Row("mtl-1", "MTL 1", "mtl", (0.1, 0.1, 0.2), (0.03841, 0.01326, 0.9914)),
    Row("mtl-2", "MTL 2", "mtl", (0.2, 0.2, 0.6), (0.02655, 0.01233, 0.9915)),
    Row("mtl-3", "MTL 3", "mtl", (0.3, 0.2, 0.5), (0.02253, 0.0115, 0.9878)),
    Row("mtl-4", "MTL 4", "mtl", (0.5, 0.3, 0.2), (0.01739, 0.01838, 0.9803)),
)


def ablation_rows(backbone: str = BACKBONE, only: str = "") -> tuple[Row, ...]:
    """Return the rows of the table: the paper's seven rows, a row for DeepDriving, and a row for
    the network `backbone`.

    `only`: names of the rows to return, separated by commas; empty: all rows. Raises UserError for
    an unknown name, and when `backbone` is not a torchvision backbone.
    """
    plan = find_architecture(backbone)
    if not plan.backbone:
        raise UserError(f"{backbone} is not a backbone of torchvision; give {BACKBONE} or another")
    others = (find_architecture("deepdriving"), plan)
    titles = ("DeepDriving (Chen et al.)", backbone)
    rows = PAPER_ROWS + tuple(
        Row(p.name, title, p.name, p.default_alpha) for p, title in zip(others, titles, strict=True)
    )
    names = [name.strip() for name in only.split(",")] if only else [row.name for row in rows]
    if unknown := [name for name in names if name not in {row.name for row in rows}]:
        known = ", ".join(row.name for row in rows)
        raise UserError(f"there is no row {unknown[0]!r} in the ablation; choose from {known}")
    return tuple(row for row in rows if row.name in names)


@dataclass(frozen=True)
class Run:
    """The training of one row with one seed, and the folder of its run."""

    row: Row
    seed: int
    folder: Path

    @property
    def state(self) -> str:
        """State of the run: finished, stopped (training or evaluation incomplete) or new."""
        if read_evaluation(self.folder) is not None:
            return "finished"
        return "stopped" if (self.folder / CONFIG).is_file() else "new"


Train = Callable[[TrainConfig, dict[str, Any] | None], Any]
Evaluate = Callable[[Path, AblationConfig], dict[str, Any]]


def plan_runs(config: AblationConfig, rows: Sequence[Row]) -> list[Run]:
    """Return all runs, ordered by seed, so that every row has a result after the runs of the first
    seed."""
    return [
        Run(row, seed, config.out / "runs" / f"{row.name}-seed{seed}")
        for seed in config.seeds
        for row in rows
    ]


def training_config(config: AblationConfig, run: Run) -> TrainConfig:
    """Return the configuration of a run's training. Raises UserError for options that a training
    refuses."""
    return TrainConfig(
        data=config.data,
        out=run.folder,
        network=run.row.network,
        alpha=run.row.alpha,
        recipe=config.recipe,
        iterations=config.iterations,
        seed=run.seed,
        batch=config.batch,
        device=config.device,
        threads=config.threads,
    )


def require_same_settings(config: AblationConfig, content_hash: str) -> None:
    """Check that the folder `config.out` belongs to an ablation with the same settings. If the
    folder is new or empty, write the settings to it.

    `content_hash`: the hash of the dataset, which is one of the settings. Raises UserError if the
    folder has other settings, or has no settings but other files.
    """
    settings = {**config.shared_settings(), "content_hash": content_hash}
    path = config.out / SETTINGS
    if path.is_file():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UserError(f"{path} is damaged ({error}); give a new --out") from error
        for name, value in settings.items():
            if found.get(name) != value:
                raise UserError(
                    f"the ablation in {config.out} was made with {name} {found.get(name)}, now it "
                    f"is {value}; rows would not be comparable: give a new --out"
                )
        return
    if config.out.exists() and any(config.out.iterdir()):
        raise UserError(
            f"{config.out} holds other files ({SETTINGS} is missing); give another --out"
        )
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(path, settings)


def finish_runs(
    config: AblationConfig, runs: Sequence[Run], train: Train, evaluate: Evaluate
) -> Iterator[Run]:
    """Train and evaluate the unfinished runs one after another, and yield each run once it is
    finished.

    `train(config, resumed)` trains a run; `resumed` is the stored description of the data of a
    stopped run that continues, None for a new run. `evaluate(folder, config)` returns the
    evaluation of a trained run.
    """
    for run in runs:
        if run.state != "finished":
            _finish(config, run, train, evaluate)
        yield run


def _finish(config: AblationConfig, run: Run, train: Train, evaluate: Evaluate) -> None:
    """Train or resume the run, evaluate it, and delete its checkpoints."""
    train_config = training_config(config, run)
    if not (run.folder / CARD).is_file():
        if (run.folder / CONFIG).is_file():
            given = {k: v for k, v in vars(train_config).items() if k not in ("out", "minutes")}
            train(*resume_config(run.folder, given))
        else:
            # Without a configuration the folder is a remnant of a process that was killed early.
            shutil.rmtree(run.folder, ignore_errors=True)
            train(train_config, None)
    result = evaluate(run.folder, config)
    atomic_write(run.folder / EVALUATION, json.dumps(result) + "\n", fsync=True)
    # The checkpoints take more than 200 MB per run, and a finished run does not need them.
    shutil.rmtree(run.folder / CHECKPOINTS, ignore_errors=True)


def read_evaluation(folder: Path) -> dict[str, Any] | None:
    """Read the evaluation of the run in `folder`; None if the evaluation is missing or damaged, or
    if the run's weights have changed since the evaluation."""
    if not (folder / EVALUATION).is_file() or not (folder / CARD).is_file():
        return None
    try:
        result: dict[str, Any] = json.loads((folder / EVALUATION).read_text(encoding="utf-8"))
    except ValueError:
        return None
    return result if result.get("model_hash") == read_card(folder).model_hash else None


# The figures of an ablation, mean and spread over its seeds, and its training curves.


@dataclass(frozen=True)
class Column:
    """A column of the table. `task`: index of the task that the column measures, in the task
    weights alpha (distance, angle, class).

    `path`: the keys that lead to the value in an evaluation; `scale`: factor by which the HTML page
    multiplies the value.
    """

    name: str
    title: str
    unit: str
    digits: int
    task: int
    path: tuple[str, ...]
    scale: float = 1.0


LOSSES = (
    Column("distance_absolute", "distance loss", "absolute", 4, 0, ("coded", "distance_absolute")),
    Column("angle_absolute", "angle loss", "absolute", 5, 1, ("coded", "angle_absolute")),
    Column("accuracy", "type accuracy", "%", 2, 2, ("heading_accuracy",), scale=100.0),
)
ERRORS = (
    *(Column(marking, marking, "m", 3, 0, ("mae_m", marking)) for marking in tf.MARKINGS),
    Column("to_lane_centre", "to lane centre", "m", 3, 0, ("to_lane_centre_mae_m",)),
    Column("angle", "angle", "rad", 4, 1, ("angle_mae_rad",)),
)
COLUMNS = LOSSES + ERRORS
MAX_CURVE_POINTS = 120


def figures(result: Any) -> dict[str, float | None]:
    """Return the value of each of `COLUMNS`, by its name, from `result`, an evaluation by
    `mtlnet.evaluation.evaluate`. A value is None where the evaluation has none."""
    return {column.name: reduce(getitem, column.path, result) for column in COLUMNS}


def table(rows: Sequence[Row], runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return an entry for each row: {"row", "seeds", "frames", "figures"}.

    "figures" is {column: {"mean", "std", "values"} or None}; None where the row did not learn the
    column's task. "std" is the sample standard deviation over the seeds; None for a single seed.
    "frames" is the number of evaluated frames.
    """
    entries = []
    for row in rows:
        found = [(run.seed, read_evaluation(run.folder)) for run in runs if run.row == row]
        done = [(seed, result) for seed, result in found if result is not None]
        each = [figures(result) for _, result in done]
        entries.append(
            {
                "row": asdict(row),
                "seeds": [seed for seed, _ in done],
                "frames": done[0][1]["frames"] if done else None,
                "figures": {
                    c.name: _mean_and_std([f[c.name] for f in each])
                    if row.alpha[c.task] > 0
                    else None
                    for c in COLUMNS
                },
            }
        )
    return entries


def best(entries: Sequence[dict[str, Any]], column: str) -> int | None:
    """Return the index of the entry with the best mean in `column`: the highest accuracy, else the
    lowest loss or error. None if no entry has a mean."""
    found = [(entry["figures"][column], i) for i, entry in enumerate(entries)]
    means = [(figure["mean"], i) for figure, i in found if figure is not None]
    return (max if column == "accuracy" else min)(means, default=(None, None))[1]


def training_curve(
    runs: Sequence[Run], row: Row, task: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return steps (P,) and training losses (seeds, P) of a task, with at most 120 points P; None
    if no run of `row` is finished.

    Each point is the mean over an equal share of the logged points, which smooths the curve.
    """
    series = []
    for run in runs:
        points = read_curves(run.folder / CURVES) if run.row == row else []
        if points and run.state == "finished":
            series.append(np.array([[p["step"], p[f"{task}_loss"]] for p in points]))
    if not series:
        return None
    length = min(len(points) for points in series)
    chunks = np.array_split(np.arange(length), min(MAX_CURVE_POINTS, length))
    steps = np.array([series[0][chunk, 0].max() for chunk in chunks])
    return steps, np.array([[p[chunk, 1].mean() for chunk in chunks] for p in series])


def _mean_and_std(values: list[float | None]) -> dict[str, Any] | None:
    present = [value for value in values if value is not None]
    if not present:
        return None
    std = float(np.std(present, ddof=1)) if len(present) > 1 else None
    return {"mean": float(np.mean(present)), "std": std, "values": present}

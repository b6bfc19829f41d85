"""The paper's ablation: which tasks to learn together, and how much of each; and two yardsticks.

Every row is trained anew for each seed, with equal iterations, on the same data, and judged on the
same rounds, in float32. A run is an ordinary run folder; what is finished is kept, so that a
killed ablation goes on where it stood.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.curves import CURVES, read_curves
from mtlnet.inference.model_card import CARD, read_card
from mtlnet.model.architecture import find_architecture
from mtlnet.training.checkpoint import FOLDER as CHECKPOINTS
from mtlnet.training.config import CONFIG, TrainConfig, resume_config
from mtlnet.training.loss import Alpha
from mtlnet.training.recipes import find_recipe
from runtime.files import atomic_write
from trackfeatures.errors import UserError

SETTINGS, EVALUATION = "settings.json", "evaluation.json"
BACKBONE = "mobilenet_v3_small"


@dataclass(frozen=True)
class Row:
    """One row of the table; `paper`: its distance loss, angle loss and accuracy there."""

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


def rows_of(backbone: str = BACKBONE) -> tuple[Row, ...]:
    """The paper's seven rows, DeepDriving and a backbone; UserError when it is none."""
    plan = find_architecture(backbone)
    if not plan.backbone:
        raise UserError(f"{backbone} is no backbone of torchvision; give {BACKBONE} or another")
    others = (find_architecture("deepdriving"), plan)
    titles = ("DeepDriving (Chen et al.)", backbone)
    return PAPER_ROWS + tuple(
        Row(p.name, title, p.name, p.default_alpha) for p, title in zip(others, titles, strict=True)
    )


@dataclass(frozen=True)
class AblationConfig:
    """One ablation. `rows` and `seeds` may grow from one call to the next, nothing else changes."""

    data: Path
    out: Path
    iterations: int
    seeds: tuple[int, ...] = (1, 2, 3)
    recipe: str = "fast"
    batch: int = 32
    split: str = "test"
    every: int = 5
    """Each so many-th frame is judged."""
    device: str = "auto"
    threads: int = 0

    def __post_init__(self) -> None:
        find_recipe(self.recipe)
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise UserError(f"--seeds {self.seeds} must be different numbers, at least one")

    def fixed(self) -> dict[str, Any]:
        """What makes two runs comparable."""
        same = ("iterations", "recipe", "batch", "split", "every")
        return {"definitions": tf.VERSION, **{name: getattr(self, name) for name in same}}


@dataclass(frozen=True)
class Run:
    """One row with one seed, and its folder."""

    row: Row
    seed: int
    folder: Path

    @property
    def state(self) -> str:
        """finished, stopped (its training or its evaluation is not complete) or new."""
        if read_evaluation(self.folder) is not None:
            return "finished"
        return "stopped" if (self.folder / CONFIG).is_file() else "new"


Train = Callable[[TrainConfig, dict[str, Any] | None], Any]
Judge = Callable[[Path, AblationConfig], dict[str, Any]]


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds "1,2,3"; UserError when one is no number from 0."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() for part in parts):
        raise UserError(f"--seeds {text!r} has no numbers; give them as 1,2,3")
    return tuple(int(part) for part in parts)


def plan_runs(config: AblationConfig, rows: Sequence[Row]) -> list[Run]:
    """All runs, the first seed of every row first: an early table is a whole one."""
    return [
        Run(row, seed, config.out / "runs" / f"{row.name}-seed{seed}")
        for seed in config.seeds
        for row in rows
    ]


def require_same_settings(config: AblationConfig, content_hash: str) -> None:
    """Write what all runs of the folder share, or raise UserError when it is something else."""
    wanted = {**config.fixed(), "content_hash": content_hash}
    path = config.out / SETTINGS
    if path.is_file():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UserError(f"{path} is damaged ({error}); give a new --out") from error
        for name, value in wanted.items():
            if found.get(name) != value:
                raise UserError(
                    f"the ablation in {config.out} was made with {name} {found.get(name)}, now it "
                    f"is {value}; rows would not be comparable: give a new --out"
                )
        return
    if config.out.exists() and any(config.out.iterdir()):
        raise UserError(f"{config.out} holds something else ({SETTINGS} is missing); give another")
    config.out.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(wanted, indent=1) + "\n").encode(), fsync=True)


def carry_out(
    config: AblationConfig, runs: Sequence[Run], train: Train, judge: Judge
) -> Iterator[Run]:
    """Finish the runs one by one; each is given out when it is finished, old ones at once."""
    for run in runs:
        if run.state != "finished":
            _finish(config, run, train, judge)
        yield run


def _finish(config: AblationConfig, run: Run, train: Train, judge: Judge) -> None:
    """Train (or go on), judge, and drop what only training needs."""
    wanted = TrainConfig(
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
    if not (run.folder / CARD).is_file():
        if (run.folder / CONFIG).is_file():
            given = {k: v for k, v in vars(wanted).items() if k not in ("out", "minutes")}
            train(*resume_config(run.folder, given))
        else:
            # A folder without a configuration: killed while it was made.
            shutil.rmtree(run.folder, ignore_errors=True)
            train(wanted, None)
    result = judge(run.folder, config)
    atomic_write(run.folder / EVALUATION, (json.dumps(result) + "\n").encode(), fsync=True)
    # Twice 100 MB and more a run, of no use once it is finished.
    shutil.rmtree(run.folder / CHECKPOINTS, ignore_errors=True)


def read_evaluation(folder: Path) -> dict[str, Any] | None:
    """The evaluation of a finished run; None while there is none, or of other weights."""
    if not (folder / EVALUATION).is_file() or not (folder / CARD).is_file():
        return None
    try:
        result: dict[str, Any] = json.loads((folder / EVALUATION).read_text(encoding="utf-8"))
    except ValueError:
        return None
    return result if result.get("model_hash") == read_card(folder).model_hash else None


# The figures of an ablation, mean and spread over its seeds, and its training curves.


# Name, heading, unit, digits, and which task it judges (index into alpha).
LOSSES = (
    ("distance_loss", "distance loss", "squared", 5, 0),
    ("distance_absolute", "distance loss", "absolute", 4, 0),
    ("angle_loss", "angle loss", "squared", 5, 1),
    ("angle_absolute", "angle loss", "absolute", 5, 1),
    ("accuracy", "type accuracy", "%", 2, 2),
)
ERRORS = (
    *((marking, marking, "m", 3, 0) for marking in tf.MARKINGS),
    ("to_lane_centre", "to lane centre", "m", 3, 0),
    ("angle", "angle", "rad", 4, 1),
)
COLUMNS = LOSSES + ERRORS
# After which columns the paper's figures stand: it does not say how its losses are taken.
PAPER_COLUMNS = ("distance_absolute", "angle_absolute", "accuracy")
POINTS = 120  # of a curve


def figures(result: dict[str, Any]) -> dict[str, float | None]:
    """What the table says of one evaluation, for each of `COLUMNS`."""
    return {
        "distance_loss": result["coded"]["distance"],
        "distance_absolute": result["coded"]["distance_absolute"],
        "angle_loss": result["coded"]["angle"],
        "angle_absolute": result["coded"]["angle_absolute"],
        "accuracy": result["heading_accuracy"],
        **{marking: result["mae_m"][marking] for marking in tf.MARKINGS},
        "to_lane_centre": result["to_lane_centre_mae_m"],
        "angle": result["angle_mae_rad"],
    }


def table(rows: Sequence[Row], runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One entry a row: {"row", "seeds", "figures": {column: {"mean", "std", "values"} or None}}.

    A column is None where the row did not learn that task. `std` is the sample standard deviation
    over the seeds, None of a single one.
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
                    name: _spread([f[name] for f in each]) if row.alpha[task] > 0 else None
                    for name, _, _, _, task in COLUMNS
                },
            }
        )
    return entries


def best(entries: Sequence[dict[str, Any]], column: str) -> int | None:
    """The entry that is best in a column, by its mean; None while there is none."""
    means = [
        (entry["figures"][column] or {}).get("mean", None) if entry["seeds"] else None
        for entry in entries
    ]
    present = [(mean, i) for i, mean in enumerate(means) if mean is not None]
    if not present:
        return None
    return (max if column == "accuracy" else min)(present)[1]


def training_curve(
    runs: Sequence[Run], row: Row, task: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Steps (P,) and losses (seeds, P) of a task in training; None without a finished run.

    Each point is the mean of an equal share of the logged ones: the loss of a batch jumps.
    """
    series = []
    for run in runs:
        points = read_curves(run.folder / CURVES) if run.row == row else []
        if points and run.state == "finished":
            series.append(np.array([[p["step"], p[f"{task}_loss"]] for p in points]))
    if not series:
        return None
    length = min(len(points) for points in series)
    chunks = np.array_split(np.arange(length), min(POINTS, length))
    steps = np.array([series[0][chunk, 0].max() for chunk in chunks])
    return steps, np.array([[p[chunk, 1].mean() for chunk in chunks] for p in series])


def _spread(values: list[float | None]) -> dict[str, Any] | None:
    present = [value for value in values if value is not None]
    if not present:
        return None
    std = float(np.std(present, ddof=1)) if len(present) > 1 else None
    return {"mean": float(np.mean(present)), "std": std, "values": present}

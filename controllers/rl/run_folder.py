"""The folder of a training: its options, its curves, and the best actor.

`config.json` has the options and the hashes of the roads. `curve.csv` and `tensorboard/` (if the
package is installed) have a point for each evaluation. `actor.safetensors` and `actor.json` contain
the best actor.
"""

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, replace
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from controllers.laws.actor import Actor, save_actor
from controllers.rl.checkpoint import Learner, Progress, load_checkpoint, save_checkpoint
from controllers.rl.config import TrainConfig, resolve
from runtime.files import atomic_write, write_json
from simulator.track.geometry import Track
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from runtime.tensorboard import TensorBoardWriter

ROADS = "roads"
"""Key of `config.json`: the hash (`Track.driving_hash`) of each track of the training, by name.
Trainings of earlier versions do not have this key."""
CONFIG, CURVE, TENSORBOARD = "config.json", "curve.csv", "tensorboard"
COLUMNS = ("step", "seconds", "episodes", "loss", "score_per_step", "mean_abs_d_m", "max_abs_d_m")
UNCOMPARED = ("out", "threads", "resume")
"""Options that may differ from the stored options when a training continues. `out` may differ,
because the folder may have been moved."""


def stored_config(run: Path) -> TrainConfig:
    """Read the configuration of the training in the folder `run`, to continue it.

    Raises UserError if the folder has no configuration, or if its file is damaged.
    """
    if not (run / CONFIG).is_file():
        raise UserError(
            f"{run} holds no training ({CONFIG} is missing); give the --out of a training to "
            "continue, or leave --resume out"
        )
    return replace(_read(run / CONFIG), out=run)


def prepare_folder(config: TrainConfig, tracks: Iterable[Track]) -> None:
    """Make the folder of a run on `tracks`. If it contains a run already, raise UserError unless
    this run has the same configuration and the same roads."""
    path = config.out / CONFIG
    roads = {track.name: track.driving_hash for track in tracks}
    if not path.exists():
        config.out.mkdir(parents=True, exist_ok=True)
        write_json(path, _content(config) | {ROADS: roads})
        return
    found, now = _content(_read(path)), _content(config)
    changed = [name for name in now if name not in UNCOMPARED and found[name] != now[name]]
    if changed:
        raise UserError(
            f"{config.out} holds a training with another {', '.join(changed)}; give another "
            "--out, or --resume to continue it"
        )
    _require_same_roads(path, roads)


def _require_same_roads(path: Path, roads: dict[str, str]) -> None:
    """Raise UserError if the `config.json` at `path` has hashes of roads that differ from `roads`
    (hashes by name)."""
    stored = json.loads(path.read_text(encoding="utf-8")).get(ROADS, roads)
    names = sorted(name for name in {**stored, **roads} if stored.get(name) != roads.get(name))
    if names:
        name, more = names[0], f" and {len(names) - 1} more" if len(names) > 1 else ""
        if name not in stored:
            what = "was not there"
        else:
            what = "has changed" if name in roads else "is missing now"
        raise UserError(
            f"{path.parent} was started on other roads: track {name} {what}{more}; restore "
            "the tracks ($TORCS_TRACKS, --tracks-dir) or give another --out"
        )


def _content(config: TrainConfig) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(json.dumps(asdict(config), default=str))
    return content


def _read(path: Path) -> TrainConfig:
    """Read the options in a `config.json`. Options that did not exist at the time of the training
    get their defaults."""
    try:
        found = dict(json.loads(path.read_text(encoding="utf-8")))
        known = {
            field.name: found[field.name] for field in fields(TrainConfig) if field.name in found
        }
        for name in ("out", "tracks_dir"):
            if known.get(name) is not None:
                known[name] = Path(known[name])
        return resolve(TrainConfig(**known))
    except (ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({error}); give another --out") from error


def _open_tensorboard(folder: Path, purge_step: int | None) -> "TensorBoardWriter | None":
    """Open a writer of TensorBoard's files; None if the package is not installed."""
    if find_spec("tensorboard") is None:
        return None
    from runtime.tensorboard import TensorBoardWriter

    return TensorBoardWriter(folder, purge_step)


class RunFolder:
    """The files of one training. An existing checkpoint is loaded."""

    def __init__(self, run: Path, learner: Learner) -> None:
        self._run, self._learner = run, learner
        resumed = load_checkpoint(run, learner)
        self.progress = resumed or Progress()
        self._started = time.monotonic() - self.progress.seconds
        step = self.progress.step + 1 if resumed else None
        self._tensorboard = _open_tensorboard(run / TENSORBOARD, step)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._tensorboard is not None:
            self._tensorboard.close()

    def tick(self) -> None:
        """Update the duration of the training."""
        self.progress.seconds = time.monotonic() - self._started

    def add_point(self, values: Mapping[str, float]) -> None:
        """Add a point with the `values` by name to TensorBoard's curves of the training."""
        if self._tensorboard is not None:
            named = {f"train/{name}": value for name, value in values.items()}
            self._tensorboard.add(self.progress.step, named)

    def add_evaluation(self, score: float, mean_m: float, max_m: float, actor: Actor) -> None:
        """Add a point to the curves, save the `actor` if it is the best, and write a checkpoint.

        `score` is the reward per step; `mean_m` and `max_m` are the mean and the largest offset
        (m).
        """
        progress = self.progress
        self.tick()
        if score > progress.best_score:
            progress.best_score, progress.best_step = score, progress.step
            save_actor(self._run, actor)
        progress.evaluated = progress.step
        seconds = round(progress.seconds, 1)
        row = (progress.step, seconds, progress.episode, progress.loss, score, mean_m, max_m)
        progress.curve.append(row)
        text = "\n".join(",".join(map(str, row)) for row in (COLUMNS, *progress.curve))
        atomic_write(self._run / CURVE, text + "\n")
        if self._tensorboard is not None:
            named = {
                f"drive/{name}": value for name, value in zip(COLUMNS[3:], row[3:], strict=True)
            }
            self._tensorboard.add(progress.step, named)
        save_checkpoint(self._run, self._learner, progress)

    def result(self) -> dict[str, Any]:
        """Return the result of the training: the folder, the steps, episodes and seconds, and the
        step and the score per step of the best actor."""
        progress = self.progress
        return {
            "out": str(self._run),
            "steps": progress.step,
            "episodes": progress.episode,
            "seconds": round(progress.seconds, 1),
            "best_step": progress.best_step,
            "best_score_per_step": progress.best_score,
        }

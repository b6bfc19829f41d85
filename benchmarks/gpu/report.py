"""Stores the results of a GPU run: `gpu_run.json` in its work folder and in its output folder.

The file is written after each stage, so that a stopped run keeps the results of its finished
stages. If the run is started again with the same work folder, it continues with the next stage.
"""

import csv
import json
import statistics
from itertools import pairwise
from pathlib import Path
from typing import Any

from runtime.files import atomic_write, write_json
from trackfeatures.errors import UserError

NAME = "gpu_run.json"
FORMAT = 1
MAX_CURVE_ROWS = 2_000
MAX_BYTES = 16 * 2**20
"""Largest size of the output folder in bytes."""
DONE, FAILED, STOPPED, SKIPPED, RUNNING = "done", "failed", "stopped", "skipped", "running"
WHOLE_RUN = 150_000
"""Number of steps of a whole training with the recipe `paper`."""


class Report:
    """The results of all stages, by the name of the stage. `work` is the folder that is kept
    between runs, `out` the output folder for the user. `rehearsal`: whether the run is a
    rehearsal."""

    def __init__(self, work: Path, out: Path, rehearsal: bool) -> None:
        """Read the results in `work`. Raises UserError if their format differs, or if they are of a
        rehearsal and this run is not, or vice versa."""
        work.mkdir(parents=True, exist_ok=True)
        out.mkdir(parents=True, exist_ok=True)
        self.work, self.out = work, out
        self.content: dict[str, Any] = {"format": FORMAT, "rehearsal": rehearsal, "stages": {}}
        path = work / NAME
        if path.is_file():
            self.content = json.loads(path.read_text(encoding="utf-8"))
            if (self.content["format"], self.content["rehearsal"]) != (FORMAT, rehearsal):
                raise UserError(
                    f"{path} is of another kind of run; give the same options as then, or another "
                    "--work"
                )

    def is_done(self, stage: str) -> bool:
        return bool(self.stage(stage).get("status") == DONE)

    def stage(self, name: str) -> dict[str, Any]:
        """Return the result of the stage `name`; {} before the stage has run."""
        found: dict[str, Any] = self.content["stages"].get(name, {})
        return found

    def add(self, stage: str, status: str, seconds: float, found: dict[str, Any]) -> None:
        """Store the result of a stage, with its status and duration, and write all results."""
        entry = {**found, "status": status, "seconds": round(seconds, 1)}
        self.content["stages"][stage] = entry
        self.save()

    def save(self, **changes: Any) -> None:
        """Update the content with `changes` and write all results to both folders."""
        self.content.update(changes)
        for folder in (self.work, self.out):
            write_json(folder / NAME, self.content)

    def copy_curves(self, curves: Path, name: str) -> None:
        """Write every n-th row of the CSV file `curves` to the file `name` in `out`. n is chosen so
        that at most MAX_CURVE_ROWS rows are written."""
        if not curves.is_file():
            return
        with curves.open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
        step = -(-len(rows) // MAX_CURVE_ROWS) or 1
        kept = rows[::-1][::step][::-1]  # includes the last row
        atomic_write(self.out / name, "".join(",".join(row) + "\n" for row in (header, *kept)))

    def copy_model(self, model: Path) -> None:
        """Copy the files of the folder `model` (weights and card) into `out`/model."""
        (self.out / "model").mkdir(exist_ok=True)
        for file in sorted(model.iterdir()):
            atomic_write(self.out / "model" / file.name, file.read_bytes())

    def out_bytes(self) -> int:
        return sum(path.stat().st_size for path in self.out.rglob("*") if path.is_file())


def timing(points: list[dict[str, float]]) -> dict[str, Any]:
    """Return steps, seconds and speed of a training from the rows of its curves; {} without rows.

    `step_ms`: median time of a step. `whole_run_s`: time in s of 150,000 steps, extrapolated from
    the steps after the first row, because the GPU's code is compiled in the ten steps before it.
    """
    if not points:
        return {}
    first, last = points[0], points[-1]
    found = {
        "steps": int(last["step"]),
        "train_seconds": last["elapsed_s"],
        "images_per_second": round(statistics.median(p["images_per_second"] for p in points), 1),
    }
    taken = last["step"] - first["step"]
    if taken:
        each = (last["elapsed_s"] - first["elapsed_s"]) / taken
        gaps = [
            (b["elapsed_s"] - a["elapsed_s"]) / (b["step"] - a["step"]) for a, b in pairwise(points)
        ]
        found["step_ms"] = round(1e3 * statistics.median(gaps), 4)
        found["whole_run_s"] = round(first["elapsed_s"] + each * (WHOLE_RUN - first["step"]), 1)
    return found

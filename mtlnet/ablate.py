"""`mtlnet ablate --out FOLDER --iterations N --seeds 1,2,3`: the table of the paper, made anew.

The folder holds `runs/ROW-seedS`, `ablation.json` and `ablation.html`, written again after every
finished run: the page can be read while the ablation goes on.
"""

import json
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from datagen.recording import Dataset
from mtlnet.ablation import (
    AblationConfig,
    Row,
    Run,
    carry_out,
    plan_runs,
    require_same_settings,
)
from mtlnet.ablation_page import page
from mtlnet.ablation_table import table
from mtlnet.card import Camera
from mtlnet.config import TrainConfig
from mtlnet.curves import CURVES, read_curves
from mtlnet.device import choose_device
from mtlnet.engine import load_engine
from mtlnet.evaluate import evaluate
from mtlnet.learn import Progress
from mtlnet.loader import Loader
from mtlnet.material import open_training_data
from mtlnet.plan import find_plan
from mtlnet.readable import require_all_decodable
from mtlnet.recipe import find_recipe
from mtlnet.train import train
from mtlnet.trainer import Trainer
from mtlnet.whole import write_whole
from trackfeatures.errors import UserError

TIMED_STEPS = 2
SAY_SECONDS = 30.0


def ablate(config: AblationConfig, rows: Sequence[Row], *, dry_run: bool = False) -> dict[str, Any]:
    """Carry an ablation out, or only say what it would do; what `--json` prints.

    Raises UserError when the folder was made with other settings, or a run fails.
    """
    console = Console(stderr=True)
    dataset = open_training_data(config.data)
    dataset.select(config.split)  # raises where there are no such rounds
    runs = plan_runs(config, rows)
    if dry_run:
        return _tell_plan(config, runs, dataset, console)
    require_all_decodable(dataset, ("train", config.split))  # once for all runs
    require_same_settings(config, dataset.content_hash)
    for number, run in enumerate(carry_out(config, runs, _trainer(console), _judge), 1):
        console.print(f"{number} of {len(runs)}: {run.folder} is finished")
        write_result(config, rows, runs)
    console.print(f"the table: {config.out / 'ablation.html'}")
    return write_result(config, rows, runs)


def write_result(config: AblationConfig, rows: Sequence[Row], runs: list[Run]) -> dict[str, Any]:
    """Write `ablation.json` and `ablation.html` of what is finished; the content of the former."""
    entries = table(rows, runs)
    result = {**config.fixed(), "data": str(config.data), "rows": entries}
    write_whole(config.out / "ablation.json", (json.dumps(result, indent=1) + "\n").encode())
    write_whole(config.out / "ablation.html", page(config, entries, rows, runs).encode())
    return result


def _trainer(console: Console) -> Any:
    """`train` that says how far it is now and then."""

    def work(config: TrainConfig, resumed: dict[str, Any] | None) -> None:
        said = time.perf_counter()
        console.print(f"training {config.out}")

        def report(point: Progress) -> None:
            nonlocal said
            if time.perf_counter() - said > SAY_SECONDS:
                said = time.perf_counter()
                console.print(
                    f"  step {point.step} of {config.iterations}, "
                    f"{point.images_per_second:.0f} images/s"
                )

        try:
            train(config, resumed, report, checked=True)
        except UserError as error:
            raise UserError(f"the run in {config.out} failed: {error}") from error

    return work


def _judge(run: Path, config: AblationConfig) -> dict[str, Any]:
    """The evaluation of a finished run, in float32."""
    engines = [load_engine(run, "openvino", "f32") for _ in range(os.cpu_count() or 1)]
    return evaluate(engines, config.data, config.split, every=config.every)


def _tell_plan(
    config: AblationConfig, runs: Sequence[Run], dataset: Dataset, console: Console
) -> dict[str, Any]:
    """The plan with the seconds that each run still needs."""
    seconds = {
        name: step_seconds(config, name, runs, dataset)
        for name in dict.fromkeys(run.row.network for run in runs)
    }
    plan = []
    for run in runs:
        left = 0.0 if run.state == "finished" else config.iterations * seconds[run.row.network]
        alpha = list(run.row.alpha)
        plan.append(
            {
                "run": str(run.folder),
                "network": run.row.network,
                "alpha": alpha,
                "seed": run.seed,
                "state": run.state,
                "seconds": round(left),
            }
        )
        console.print(f"{run.folder}  {run.row.network} {alpha}: {run.state}, {left / 60:.1f} min")
    total = sum(entry["seconds"] for entry in plan)  # type: ignore[misc]  # ints
    console.print(f"{len(runs)} runs of {config.iterations} steps, about {total / 3600:.1f} h left")
    return {"runs": plan, "seconds": total, "step_seconds": seconds}


def step_seconds(
    config: AblationConfig, network: str, runs: Sequence[Run], dataset: Dataset
) -> float:
    """Seconds a step: as finished runs of the network took, else of a few steps taken now."""
    speeds = [
        point["images_per_second"]
        for run in runs
        if run.row.network == network and run.state == "finished"
        for point in read_curves(run.folder / CURVES)
    ]
    if speeds:
        return config.batch / statistics.median(speeds)
    recipe, plan = find_recipe(config.recipe), find_plan(network)
    camera = Camera(**dataset.camera.as_dict())  # type: ignore[arg-type]  # sizes are int
    loader = Loader(dataset.select("train"), camera, config.batch, 0, augment=recipe.augment)
    device = choose_device(config.device)
    trainer = Trainer(recipe, plan.default_alpha, 0, device, plan)
    trainer.standardise(loader)
    batch, taken = loader.make(0), []
    for _ in range(1 + TIMED_STEPS):
        begin = time.perf_counter()
        float(trainer.step(batch, 0.5).distance)  # waits for a GPU
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken[1:])  # the first one chooses kernels

"""The `mtlnet` command: train, evaluate and ask the perception network."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from runtime.cli import main as run_command

if TYPE_CHECKING:
    from mtlnet.inference.engine import Engine

app = typer.Typer(
    help="Train, evaluate and ask the multi-task perception network.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
MODEL_HELP = 'Run folder, name in runs/, "latest", or "default" (the weights shipped).'
Model = Annotated[str, typer.Option(help=MODEL_HELP)]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Data = Annotated[Path, typer.Option(help="Dataset folder.")]
EngineKind = Annotated[str, typer.Option("--engine", help="openvino or torch (float32 oracle).")]
PrecisionOption = Annotated[
    str | None,
    typer.Option(
        help="int8 (after `mtlnet export`), bf16 or f32.  [default: int8 once it passed its gate, "
        "else bf16 where the CPU computes in it]"
    ),
]


@app.command("train")
def train_command(
    data: Annotated[
        Path | None, typer.Option(help="Dataset folder.  [default: datasets/default]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New run folder.  [default: runs/DATE-RECIPE]")
    ] = None,
    alpha: Annotated[
        str | None,
        typer.Option(help="Weights of distance, angle and type loss.  [default: 0.3,0.2,0.5]"),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(help="mtl, deepdriving, mobilenet_v3_small, regnet_y_400mf.  [default: mtl]"),
    ] = None,
    balance: Annotated[
        str | None,
        typer.Option(
            help="fixed (alpha), or weights found by uncertainty or dwa.  [default: fixed]"
        ),
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(help="Run to fine-tune, or default; --data may be images with a labels.csv."),
    ] = None,
    recipe: Annotated[
        str | None, typer.Option(help="fast (minutes) or paper (days).  [default: fast]")
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Steps.  [default: the recipe's, unless --minutes]")
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(help="Train for this long; the schedule follows the clock.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of it all.  [default: 0]")] = None,
    batch: Annotated[
        int | None, typer.Option(help="Images a step.  [default: the recipe's]")
    ] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu or cuda.  [default: auto]")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads.  [default: one a core]")] = None,
    skip_undecodable: Annotated[
        bool, typer.Option("--skip-undecodable", help="Leave out images that cannot be decoded.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the stopped run in --out (or the newest).")
    ] = False,
    as_json: Json = False,
) -> None:
    """Train the network on the train rounds of a dataset; ends with a model `serve` can load."""
    given = {
        "data": data,
        "network": network,
        "balance": balance,
        "init": init,
        "recipe": recipe,
        "iterations": iterations,
        "minutes": minutes,
        "seed": seed,
        "batch": batch,
        "device": device,
        "threads": threads,
        "skip_undecodable": skip_undecodable or None,
    }
    options: dict[str, Any] = {k: v for k, v in given.items() if v is not None}
    from mtlnet.training.start import start_training

    result = start_training(options, alpha, out, resume=resume)
    if as_json and result:
        typer.echo(json.dumps(result))


@app.command("ablate")
def ablate_command(
    out: Annotated[Path, typer.Option(help="Folder of the ablation; the same one goes on.")],
    iterations: Annotated[int, typer.Option(help="Steps of every run.")],
    data: Data = Path("datasets/default"),
    seeds: Annotated[str, typer.Option(help="Every row is trained with each.")] = "1,2,3",
    recipe: Annotated[str, typer.Option(help="fast or paper.")] = "fast",
    backbone: Annotated[
        str, typer.Option(help="The yardstick: mobilenet_v3_small or regnet_y_400mf.")
    ] = "mobilenet_v3_small",
    batch: Annotated[int, typer.Option(help="Images a step.")] = 32,
    split: Annotated[str, typer.Option(help="What to judge on: test or unseen.")] = "test",
    every: Annotated[int, typer.Option(help="Judge each so many-th frame.", min=1)] = 5,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads; 0: one a core.")] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say the plan and how long it takes.")
    ] = False,
    as_json: Json = False,
) -> None:
    """The paper's table made anew: each task alone, MTL 1 to 4, and two other networks."""
    from mtlnet.evaluation.ablation import AblationConfig, parse_seeds, rows_of
    from mtlnet.evaluation.ablation_run import ablate

    config = AblationConfig(
        data, out, iterations, parse_seeds(seeds), recipe, batch, split, every, device, threads
    )
    result = ablate(config, rows_of(backbone), dry_run=dry_run)
    if as_json:
        typer.echo(json.dumps(result))


@app.command("export")
def export_command(
    model: Model = "default",
    form: Annotated[str, typer.Option("--format", help="onnx or openvino.")] = "openvino",
    precision: Annotated[
        str, typer.Option(help="f32, bf16 (weights in half the bytes) or int8 (openvino).")
    ] = "f32",
    data: Annotated[
        Path | None, typer.Option(help="Frames to check it on.  [default: what it learned from]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder.  [default: RUN/export/FORMAT-PRECISION]")
    ] = None,
    frames: Annotated[int, typer.Option(help="How many frames to check it on.")] = 64,
    as_json: Json = False,
) -> None:
    """Write a model as ONNX or OpenVINO, checked against torch; int8 has to pass a gate."""
    from rich.console import Console

    from mtlnet.evaluation.tables import export_lines
    from mtlnet.export.convert import export_model
    from mtlnet.inference.model_card import resolve_run

    result = export_model(resolve_run(model), form, precision, data, out, frames)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        Console().print(export_lines(result))


@app.command("evaluate")
def evaluate_command(
    model: Model = "default",
    data: Data = Path("datasets/default"),
    split: Annotated[str, typer.Option(help="train, test, unseen or all.")] = "test",
    page: Annotated[
        Path | None, typer.Option("--report", help="HTML page to write: a file, or a folder.")
    ] = None,
    every: Annotated[int, typer.Option(help="Judge each so many-th frame only.")] = 1,
    engine: EngineKind = "openvino",
    precision: PrecisionOption = None,
    as_json: Json = False,
) -> None:
    """Errors in metres and radians on a dataset, beside always answering the training mean."""
    import os

    from rich.console import Console
    from rich.progress import Progress

    from mtlnet.evaluation.evaluate import evaluate
    from mtlnet.evaluation.tables import doubt_table, evaluation_table, group_table

    # The frames are shared out to engines of one thread each: that answers more of them a second
    # than one engine on all cores.
    _say_which(model)
    ready = [_load(model, engine, precision) for _ in range(os.cpu_count() or 1)]
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("evaluating")
        result = evaluate(
            ready,
            data,
            split,
            lambda done, total: bar.update(task, completed=done, total=total),
            page,
            every,
        )
    if page is not None:
        typer.echo(f"report: {result['page']}", err=True)
    if as_json:
        typer.echo(json.dumps(result))
        return
    console = Console()
    console.print(evaluation_table(result))
    console.print(group_table(result))
    if "doubt" in result:
        console.print(doubt_table(result))


@app.command("predict")
def predict_command(
    images: Annotated[list[Path], typer.Argument(help="JPEG or PNG files.")],
    model: Model = "default",
    engine: EngineKind = "openvino",
    precision: PrecisionOption = None,
    as_json: Json = False,
) -> None:
    """Track features of images from the model's camera."""
    from rich.console import Console

    from mtlnet.evaluation.tables import answer_table
    from mtlnet.inference.image_decoding.decode import read_image
    from mtlnet.inference.prediction import decode_outputs

    _say_which(model)
    ready = _load(model, engine, precision)
    answers = []
    for path in images:
        image = read_image(path, ready.card.camera)
        begin = time.perf_counter()
        answer = decode_outputs(ready(image)).as_json()
        latency_ms = round(1e3 * (time.perf_counter() - begin), 3)
        answers.append(
            {"image": str(path), **answer, "model": ready.card.name, "latency_ms": latency_ms}
        )
    if as_json:
        typer.echo(json.dumps(answers))
    else:
        Console().print(answer_table(answers))


def _say_which(model: str) -> None:
    """Tell on stderr which run a name stands for."""
    from mtlnet.inference.model_card import resolve_run

    typer.echo(f"model: {resolve_run(model)}", err=True)


def _load(model: str, kind: str, precision: str | None) -> "Engine":
    """The engine of a model, on one thread."""
    from mtlnet.inference.engine import load_engine, parse_kind, parse_precision
    from mtlnet.inference.model_card import resolve_run

    return load_engine(resolve_run(model), parse_kind(kind), parse_precision(precision), threads=1)


def main() -> None:
    """Entry point."""
    run_command(app)

"""The `mtlnet` command: train, evaluate, export and run the perception network."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.cli import main as run_command

if TYPE_CHECKING:
    from mtlnet.inference.engine import Engine

app = typer.Typer(
    help="Train, evaluate, export and run the multi-task perception network.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
MODEL_HELP = 'Run folder, name in runs/, "latest", or "default" (the weights shipped).'
Model = Annotated[str, typer.Option(help=MODEL_HELP)]
EngineKind = Annotated[
    str, typer.Option("--engine", help="openvino, or torch (float32, for comparison).")
]
Precision = Annotated[
    str | None,
    typer.Option(
        help="int8 (after `mtlnet export`), bf16 or f32.  [default: int8 once it passed its gate, "
        "else bf16 where the CPU computes in it]"
    ),
]
Data = Annotated[Path, typer.Option(help="Dataset folder.")]

# Options of `train`: None is the default of TrainConfig, or with --resume what the run has stored.
TrainData = Annotated[
    Path | None, typer.Option(help="Dataset folder.  [default: datasets/default]")
]
TrainOut = Annotated[Path | None, typer.Option(help="New run folder.  [default: runs/DATE-RECIPE]")]
Alpha = Annotated[
    str | None,
    typer.Option(
        help="Weights of the distance, angle and heading losses.  "
        "[default: the network's, 0.3,0.2,0.5 for grid and mtl]"
    ),
]
Network = Annotated[
    str | None,
    typer.Option(
        help="grid, mtl (the paper's), deepdriving, mobilenet_v3_small, regnet_y_400mf.  "
        "[default: grid, with recipe paper mtl]"
    ),
]
Heads = Annotated[
    str | None,
    typer.Option(
        help="bins (distributions) or coded (the paper's numbers).  [default: the network's]"
    ),
]
Balance = Annotated[
    str | None,
    typer.Option(
        help="Task weights: fixed (alpha), or found by uncertainty or dwa.  [default: fixed]"
    ),
]
Init = Annotated[
    str | None,
    typer.Option(
        help='Run to fine-tune, or "default"; --data may then be images with a labels.csv.'
    ),
]
TrainRecipe = Annotated[
    str | None,
    typer.Option(
        help="fast (minutes), paper (days), or tune (to fine-tune, with --init).  "
        "[default: fast, with --init tune]"
    ),
]
TrainIterations = Annotated[
    int | None, typer.Option(help="Steps.  [default: the recipe's, unless --minutes is given]")
]
Minutes = Annotated[
    float | None,
    typer.Option(help="Duration of the training; the learning rate follows the time elapsed."),
]
Seed = Annotated[int | None, typer.Option(help="Seed of all random numbers.  [default: 0]")]
TrainBatch = Annotated[int | None, typer.Option(help="Images a step.  [default: the recipe's]")]
TrainDevice = Annotated[
    str | None, typer.Option(help="auto, cpu, cuda or cuda:NUMBER.  [default: auto]")
]
TrainThreads = Annotated[int | None, typer.Option(help="CPU threads.  [default: one a core]")]
SkipUndecodable = Annotated[
    bool, typer.Option("--skip-undecodable", help="Omit images that cannot be decoded.")
]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Continue the stopped run in --out, or else the newest run."),
]

# Options of `ablate`.
AblationOut = Annotated[
    Path, typer.Option(help="Folder of the ablation; the same folder continues it.")
]
Iterations = Annotated[int, typer.Option(help="Steps of every run.")]
Seeds = Annotated[str, typer.Option(help="Every row is trained with each of them.")]
Recipe = Annotated[str, typer.Option(help="fast or paper.")]
Backbone = Annotated[
    str, typer.Option(help="Network to compare with: mobilenet_v3_small or regnet_y_400mf.")
]
Batch = Annotated[int, typer.Option(help="Images a step.")]
AblationSplit = Annotated[str, typer.Option(help="Rounds to evaluate on: test or unseen.")]
Every = Annotated[int, typer.Option(help="Evaluate every n-th frame only.", min=1)]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:NUMBER.")]
Threads = Annotated[int, typer.Option(help="CPU threads; 0: one a core.")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print the plan and its estimated duration.")
]

# Options of `export` and `evaluate`.
Format = Annotated[str, typer.Option("--format", help="onnx or openvino.")]
ExportPrecision = Annotated[
    str, typer.Option(help="f32, bf16 (weights in half the bytes) or int8 (openvino).")
]
CheckData = Annotated[
    Path | None,
    typer.Option(help="Dataset to check the export on.  [default: the training data]"),
]
ExportOut = Annotated[
    Path | None, typer.Option(help="Folder.  [default: RUN/export/FORMAT-PRECISION]")
]
CheckFrames = Annotated[int, typer.Option(help="Number of frames to check the export on.")]
Split = Annotated[str, typer.Option(help="train, test, unseen or all.")]
ReportPage = Annotated[
    Path | None, typer.Option("--report", help="HTML page to write: a file, or a folder.")
]
EveryFrame = Annotated[int, typer.Option(help="Evaluate every n-th frame only.")]
WorstSheet = Annotated[
    Path | None, typer.Option("--worst", help="JPEG to write: the frames of the largest errors.")
]
ShippedPicture = Annotated[
    Path | None, typer.Option(help="JPEG for README.md, of `mtlnet evaluate --worst`.", exists=True)
]
ShipOut = Annotated[Path, typer.Option(help="Folder for the model.")]
ShippedEvaluations = Annotated[
    list[Path] | None,
    typer.Option(help="Output of `mtlnet evaluate --json`, for README.md; several times."),
]
ShippedNotes = Annotated[
    Path | None, typer.Option(help="Markdown for README.md, such as the commands.", exists=True)
]
PredictInputs = Annotated[
    list[str],
    typer.Argument(help="JPEG or PNG files, folders of them, patterns, films, rounds (.mcap)."),
]
PredictOut = Annotated[
    list[Path] | None,
    typer.Option(
        help="Table (.csv, .jsonl), film (.mp4) or folder of pictures with the markings drawn in; "
        "may be given several times."
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(help="Vertical field of view of images and films, degrees.  [default: model's]"),
]
MAX_PRINTED = 40
"""Rows of the table that `predict` prints."""


@app.command("train")
def train_command(
    data: TrainData = None,
    out: TrainOut = None,
    alpha: Alpha = None,
    network: Network = None,
    heads: Heads = None,
    balance: Balance = None,
    init: Init = None,
    recipe: TrainRecipe = None,
    iterations: TrainIterations = None,
    minutes: Minutes = None,
    seed: Seed = None,
    batch: TrainBatch = None,
    device: TrainDevice = None,
    threads: TrainThreads = None,
    skip_undecodable: SkipUndecodable = False,
    resume: Resume = False,
    as_json: Json = False,
) -> None:
    """Train the network on the train rounds of a dataset; the result is a model for `serve`."""
    from mtlnet.training.loss import parse_alpha
    from mtlnet.training.run import start_training

    given = {
        "data": data,
        "alpha": None if alpha is None else parse_alpha(alpha),
        "network": network,
        "heads": heads,
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
    options = {name: value for name, value in given.items() if value is not None}
    result = start_training(options, out, resume=resume)
    if as_json and result:
        typer.echo(json.dumps(result))


@app.command("ablate")
def ablate_command(
    out: AblationOut,
    iterations: Iterations,
    data: Data = Path("datasets/default"),
    seeds: Seeds = "1,2,3",
    recipe: Recipe = "fast",
    backbone: Backbone = "mobilenet_v3_small",
    batch: Batch = 32,
    split: AblationSplit = "test",
    every: Every = 5,
    device: Device = "auto",
    threads: Threads = 0,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """The ablation table of the paper: each task alone, MTL 1 to 4, and two other networks."""
    from mtlnet.evaluation.ablation import AblationConfig, ablation_rows, parse_seeds
    from mtlnet.evaluation.ablation_run import ablate

    config = AblationConfig(
        data, out, iterations, parse_seeds(seeds), recipe, batch, split, every, device, threads
    )
    result = ablate(config, ablation_rows(backbone), dry_run=dry_run)
    if as_json:
        typer.echo(json.dumps(result))


@app.command("export")
def export_command(
    model: Model = "default",
    form: Format = "openvino",
    precision: ExportPrecision = "f32",
    data: CheckData = None,
    out: ExportOut = None,
    frames: CheckFrames = 64,
    as_json: Json = False,
) -> None:
    """Write a model as ONNX or OpenVINO, compared with torch; int8 must pass an accuracy gate."""
    from rich.console import Console

    from mtlnet.evaluation.tables import export_lines
    from mtlnet.export.convert import export_model
    from mtlnet.inference.model_card import resolve_run

    result = export_model(resolve_run(model), form, precision, data, out, frames)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        Console().print(export_lines(result))


@app.command("ship")
def ship_command(
    out: ShipOut,
    model: Model = "default",
    evaluation: ShippedEvaluations = None,
    notes: ShippedNotes = None,
    picture: ShippedPicture = None,
    as_json: Json = False,
) -> None:
    """Write a model as weights alone, in float16: small enough for a repository.

    With --evaluation: the page of figures of the model that is in --out.
    """
    from mtlnet.export.ship import ship_model, write_page
    from mtlnet.inference.model_card import resolve_run

    if evaluation:
        text = "" if notes is None else notes.read_text(encoding="utf-8")
        typer.echo(write_page(out, evaluation, text, picture))
        return
    result = ship_model(resolve_run(model), out)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        mib = sum(result["files"].values()) / 2**20
        typer.echo(f"{result['out']}: {mib:.1f} MiB; serve it with `serve --model {result['out']}`")


@app.command("evaluate")
def evaluate_command(
    model: Model = "default",
    data: Data = Path("datasets/default"),
    split: Split = "test",
    page: ReportPage = None,
    worst: WorstSheet = None,
    every: EveryFrame = 1,
    engine: EngineKind = "openvino",
    precision: Precision = None,
    as_json: Json = False,
) -> None:
    """Errors in metres and radians on a dataset, beside those of the constant training mean."""
    import os

    from rich.console import Console
    from rich.progress import Progress

    from mtlnet.evaluation.evaluate import evaluate
    from mtlnet.evaluation.tables import evaluation_table, group_table, uncertainty_table

    _print_model(model)
    # Several engines of one thread each take more frames a second than one engine on all cores.
    engines = [_load(model, engine, precision) for _ in range(os.cpu_count() or 1)]
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("evaluating")

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        result = evaluate(engines, data, split, report, page, every, worst)
    if page is not None:
        typer.echo(f"report: {result['page']}", err=True)
    if as_json:
        typer.echo(json.dumps(result))
        return
    console = Console()
    console.print(evaluation_table(result))
    console.print(group_table(result))
    if "doubt" in result:
        console.print(uncertainty_table(result))


@app.command("predict")
def predict_command(
    images: PredictInputs,
    model: Model = "default",
    out: PredictOut = None,
    fov_y_deg: FieldOfView = None,
    engine: EngineKind = "openvino",
    precision: Precision = None,
    as_json: Json = False,
) -> None:
    """Track features of images, films or recorded rounds; also as tables, pictures or a film."""
    from rich.console import Console
    from rich.progress import Progress

    from mtlnet.evaluation.tables import prediction_table
    from mtlnet.predict.run import predict_files

    _print_model(model)
    loaded = _load(model, engine, precision)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("predicting")

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        predictions = predict_files(loaded, images, out or (), fov_y_deg, report)
    if as_json:
        typer.echo(json.dumps(predictions))
    else:
        Console().print(prediction_table(predictions[:MAX_PRINTED]))
        if len(predictions) > MAX_PRINTED:
            typer.echo(
                f"the first {MAX_PRINTED} of {len(predictions)}; --out features.csv has all",
                err=True,
            )


def _print_model(name: str) -> None:
    """Print on stderr the run folder that a model's name stands for."""
    from mtlnet.inference.model_card import resolve_run

    typer.echo(f"model: {resolve_run(name)}", err=True)


def _load(model: str, kind: str, precision: str | None) -> "Engine":
    """The engine of a model, with one thread."""
    from mtlnet.inference.engine import load_engine, parse_kind, parse_precision
    from mtlnet.inference.model_card import resolve_run

    return load_engine(resolve_run(model), parse_kind(kind), parse_precision(precision), threads=1)


def main() -> None:
    """Entry point."""
    run_command(app)

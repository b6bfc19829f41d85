"""The `mtlnet` command: train, evaluate, export and run the perception network."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mtlnet import cli_options as options
from mtlnet.ablation.config import AblationConfig
from mtlnet.calibration.config import CalibrateConfig
from mtlnet.training.config import TrainConfig
from runtime import cli as command
from runtime.options import options_of
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from mtlnet.inference.engine import Engine

app = typer.Typer(
    help="Train, evaluate, export and run the network that answers track features of images: "
    "distances to lane markings, angle to the road, class of the road.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
SPIN_COUNT = "10000"
"""Number of iterations that OpenMP's threads spin before they sleep and free their core for the
threads that decode images. With OpenMP's default, 300,000, a training step takes 1.07 times as
long."""
MAX_PRINTED = 40
"""Maximum number of rows of the table that `predict` prints."""


@app.command("train")
@options_of(TrainConfig, only_given=True)
def train_command(
    given: dict[str, Any],
    heads: options.Heads = None,
    resume: options.Resume = False,
    as_json: command.AsJson = False,
) -> None:
    """Train a network on the train rounds of a dataset; the result is a model for `serve`.

    "The paper" is Li et al., "Reinforcement Learning and Deep Learning based Lateral Control for
    Autonomous Driving".
    """
    os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)  # torch's OpenMP reads it when it is loaded
    from mtlnet.train import start_training

    out = given.pop("out", None)
    if heads is not None:
        given["heads"] = heads
    result = start_training(given, out, resume=resume)
    if as_json and result:
        typer.echo(json.dumps(result))


@app.command("ablate")
@options_of(AblationConfig)
def ablate_command(
    config: AblationConfig,
    backbone: options.Backbone = "mobilenet_v3_small",
    rows: options.Rows = "",
    dry_run: options.DryRun = False,
    as_json: command.AsJson = False,
) -> None:
    """Repeat the paper's ablation: train networks for different tasks and compare their errors.

    The networks are the rows of a table: the paper's network for each of the three tasks alone
    (distances, angle, class of the road) and for all tasks with four sets of task weights (MTL 1 to
    MTL 4), the network DeepDriving (Chen et al. 2015), and a small network of torchvision. All are
    trained on the same data with the same number of steps. "The paper" is Li et al., "Reinforcement
    Learning and Deep Learning based Lateral Control for Autonomous Driving".
    """
    from mtlnet.ablation.plan import ablation_rows
    from mtlnet.ablation.run import ablate

    result = ablate(config, ablation_rows(backbone, rows), dry_run=dry_run)
    if as_json:
        typer.echo(json.dumps(result))


@app.command("export")
def export_command(
    model: options.Model = "default",
    form: options.Format = "openvino",
    precision: options.ExportPrecision = "f32",
    data: options.CheckData = None,
    out: options.ExportOut = None,
    frames: options.CheckFrames = 64,
    gate_only: options.GateOnly = False,
    as_json: command.AsJson = False,
) -> None:
    """Write a model in the format ONNX or OpenVINO, and compare its outputs with torch.

    A model in int8 must also pass the accuracy gate: on the test rounds its mean errors may be at
    most 0.003 m (distances), 0.0002 rad (angle) and 0.001 (share of wrong classes) larger than in
    float32. Otherwise `serve` and `mtlnet` do not use it by default.

    An ONNX model has no standard deviations and no out-of-distribution score.
    """
    from rich.console import Console

    from mtlnet.evaluation.tables import export_lines
    from mtlnet.export.convert import export_model
    from mtlnet.inference.model_card import resolve_run

    result = export_model(
        resolve_run(model), form, precision, data, out, frames, gate_only=gate_only
    )
    if as_json:
        typer.echo(json.dumps(result))
    else:
        Console(markup=False).print(export_lines(result))


@app.command("ship")
def ship_command(
    out: options.ShipOut,
    model: options.Model = "default",
    data: options.RefitData = None,
    evaluation: options.ShippedEvaluations = None,
    notes: options.ShippedNotes = None,
    picture: options.ShippedPicture = None,
    as_json: command.AsJson = False,
) -> None:
    """Write a copy of a model that takes half the space: its weights are in float16.

    The copy also contains the network in the format of OpenVINO, which `serve` loads.

    With --evaluation: write only the file README.md for the model in --out. It shows the results
    of evaluations.
    """
    from mtlnet.export.ship import check_page_options, ship_model, write_page
    from mtlnet.inference.model_card import resolve_run

    check_page_options(model, data, evaluation, notes, picture)
    if evaluation:
        page = str(write_page(out, evaluation, notes, picture))
        command.print_result({"page": page}, as_json, page)
        return
    result = ship_model(resolve_run(model), out, data)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        mib = sum(result["files"].values()) / 2**20
        typer.echo(f"{result['out']}: {mib:.1f} MiB; serve it with `serve --model {result['out']}`")


@app.command("evaluate")
def evaluate_command(
    model: options.Model = "default",
    data: options.EvaluationData = Path("datasets/default"),
    split: options.Split = "test",
    protocol: options.Protocol = "",
    page: options.ReportPage = None,
    worst: options.WorstSheet = None,
    every: options.EveryFrame = 1,
    copies: options.Copies = "",
    engine: options.EngineKind = "openvino",
    precision: options.Precision = None,
    views: command.Views = 1,
    as_json: command.AsJson = False,
) -> None:
    """Evaluate a model on a dataset: print its errors in m and rad.

    For comparison, the errors of a baseline are printed. It always answers the mean of the training
    labels.
    """
    from rich.console import Console

    from mtlnet.evaluation.evaluate import evaluate
    from mtlnet.evaluation.protocol import evaluate_protocol
    from mtlnet.evaluation.tables import report_tables

    if protocol and (page is not None or worst is not None or copies or split != "test"):
        raise UserError(
            "--protocol has its own rounds and table; leave out --split, --report, --worst and "
            "--copies"
        )

    _print_model(model)
    # Several engines of one thread each take more frames a second than one engine on all cores.
    # On a GPU these threads decode images for one engine.
    chosen, count = (model, engine, precision), os.cpu_count() or 1
    engines = count * [_load(*chosen, gpu=True, views=views)]
    if not getattr(engines[0], "on_gpu", False):
        engines[1:] = [_load(*chosen, gpu=True, views=views) for _ in engines[1:]]
    with command.progress("evaluating") as report:
        if protocol:
            result = evaluate_protocol(engines, data, protocol, report, every)
        else:
            result = evaluate(engines, data, split, report, page, every, worst, copies)
    if page is not None:
        typer.echo(f"report: {result['page']}", err=True)
    if as_json:
        typer.echo(json.dumps(result))
        return
    console = Console()
    for table in report_tables(result):
        console.print(table)


@app.command("predict")
def predict_command(
    images: options.PredictInputs,
    model: options.Model = "default",
    out: options.PredictOut = None,
    fov_y_deg: options.FieldOfView = None,
    camera: options.PredictCamera = None,
    topic: options.Topic = "",
    engine: options.EngineKind = "openvino",
    precision: options.Precision = None,
    views: command.Views = 1,
    as_json: command.AsJson = False,
) -> None:
    """Compute the track features of images, films, webcams, streams, rounds, Foxglove files or
    ROS 2 bags."""
    from rich.console import Console

    from mtlnet.evaluation.tables import prediction_table
    from mtlnet.inference.rectification import Rectification, read_camera
    from mtlnet.predict.run import InputsLeftOut, predict_files
    from mtlnet.sources.pictures import Lens

    own = str(camera) == "model"
    if camera is not None and fov_y_deg is not None and not own:
        raise UserError("--camera holds the field of view; leave --fov-y-deg out")
    _print_model(model)
    loaded = _load(model, engine, precision, views=views)
    known = loaded.card.camera
    with command.progress_bar() as bar:
        task = bar.add_task("predicting", total=None)

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        def note(line: str) -> None:
            bar.console.print(
                command.printable(line), markup=False, highlight=False, soft_wrap=True
            )

        lens: Lens = fov_y_deg
        if camera is not None and not own:
            lens = Rectification(read_camera(camera, known, note), known)
        left_out: InputsLeftOut | None = None
        given = (loaded, images, out or (), lens, report, note, topic)
        try:
            predictions = predict_files(*given, calibrate=not own, stated=not own)
        except InputsLeftOut as error:
            predictions, left_out = error.results, error
    if as_json and predictions:
        typer.echo(json.dumps(predictions))
    elif predictions:
        Console().print(prediction_table(predictions[:MAX_PRINTED]))
        if len(predictions) > MAX_PRINTED:
            typer.echo(f"the first {MAX_PRINTED} images; --out features.csv has all", err=True)
    if left_out is not None:
        raise left_out


@app.command("calibrate")
@options_of(CalibrateConfig)
def calibrate_command(config: CalibrateConfig, as_json: command.AsJson = False) -> None:
    """Make a camera file from a film of a drive (height and angles of the camera) or from pictures
    of a calibration board (lens).
    """
    from mtlnet.calibration.run import calibrate

    with command.progress("calibrating") as report:
        result, line = calibrate(config, report)
    command.print_result(result, as_json, f"{config.out}: {line}")


@app.command("label")
def label_command(
    context: typer.Context,
    folder: options.LabelFolderName,
    camera: options.LabelCamera = None,
    model: options.Model = "default",
    no_model: options.NoModel = False,
    host: options.LabelHost = "127.0.0.1",
    port: options.LabelPort = 8010,
    token_file: options.LabelToken = None,
    insecure: options.LabelInsecure = False,
    table: options.ImportTable = None,
    label_std: options.LabelStdGiven = None,
    as_json: command.AsJson = False,
) -> None:
    """Label pictures in the browser: drag the lane's two markings; distances and angle are
    computed from them.

    With --import: convert a table of labels and copy its pictures to FOLDER, without the browser.
    """
    from mtlnet.label.import_table import import_labels, parse_label_std
    from mtlnet.label.options import check_options
    from runtime.access import check_exposure, read_token

    check_options(context)
    if table is not None:
        found = import_labels(table, folder, parse_label_std(label_std or ()))
        told = f"{found['pictures']} pictures of {found['cameras']} cameras in {folder}"
        command.print_result(found, as_json, f"{told}; `mtlnet evaluate --data {folder}`")
        return
    token = read_token(token_file)
    check_exposure(host, token, insecure)
    from mtlnet.inference.model_card import read_card, resolve_run
    from mtlnet.label.folder import LabelFolder
    from mtlnet.label.server import Labeller, serve_folder

    known = read_card(resolve_run(model)).camera
    opened = LabelFolder(
        folder, camera, known, lambda line: typer.echo(command.printable(line), err=True)
    )
    engine = None if no_model else _load(model, "openvino", None)
    serve_folder(Labeller(opened, engine), host, port, token)


def _print_model(name: str) -> None:
    """Print the run folder of the model `name` on stderr."""
    from mtlnet.inference.model_card import resolve_run

    typer.echo(f"model: {resolve_run(name)}", err=True)


def _load(
    model: str, kind: str, precision: str | None, *, gpu: bool = False, views: int = 1
) -> "Engine":
    """Load a model's engine, with one thread. `gpu`: the torch engine can use a GPU."""
    from mtlnet.inference.engine import load_engine, parse_kind, parse_precision
    from mtlnet.inference.model_card import resolve_run

    return load_engine(
        resolve_run(model),
        parse_kind(kind),
        parse_precision(precision),
        threads=1,
        gpu=gpu,
        views=views,
    )


def main() -> None:
    """Run the command `mtlnet`."""
    command.main(app)

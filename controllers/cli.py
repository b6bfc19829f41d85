"""The command `controllers`. Run: `controllers drive --controller mpc --track oval`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controllers.compare import cli as compare_cli
from controllers.config import DemoConfig, DriveConfig
from controllers.record.cli import record
from controllers.rl.cli import train
from runtime import cli as command

if TYPE_CHECKING:
    from rich.console import Console

    from controllers.closed_loop import DriveResult

DRIVE, DEMO = DriveConfig(), DemoConfig()

app = typer.Typer(add_completion=False, rich_markup_mode="rich", no_args_is_help=True)

ControllerName = Annotated[
    str,
    typer.Option(
        help="lqr, lqr-preview, lqr-paper, mpc, mpc-preview, rl, torcs, a folder of `controllers "
        "train`, or your own class as MODULE:CLASS or FILE.py:CLASS."
    ),
]
Track = Annotated[str, typer.Option(help="Its name (`simulator tracks`) or file.")]
Lanes = Annotated[int, typer.Option(help="1, 2 or 3.")]
Perception = Annotated[
    str, typer.Option(help="truth, model, or a service such as http://127.0.0.1:8000")
]
Steps = Annotated[int | None, typer.Option(help="Control steps of 50 ms [default: about one lap]")]
Log = Annotated[Path | None, typer.Option(help="Write the drive to this CSV file.")]
Video = Annotated[Path | None, typer.Option(help="Film the drive (.mp4).")]
Watch = Annotated[
    int | None,
    typer.Option(
        metavar="PORT",
        min=0,
        max=65535,
        help="Show the drive live in the browser, at its real pace. 0: any free port.",
    ),
]
Latency = Annotated[float, typer.Option(help="The perception's answers come this late.")]
Drop = Annotated[float, typer.Option(help="Share of the answers that are lost.")]
Realtime = Annotated[
    bool,
    typer.Option(
        "--realtime",
        help="Drive on the wall clock: perception is asked without waiting, late answers are late. "
        "No two such drives are the same.",
    ),
]
Parameters = Annotated[
    Path | None, typer.Option(help="The controller's parameters, written by `controllers tune`.")
]
Model = Annotated[str, typer.Option(help="Run for perception model.")]
StartD = Annotated[float | None, typer.Option(help="Start this far left of the track's centre, m.")]
TargetLane = Annotated[
    int | None, typer.Option(help="Lane to follow, 0 the leftmost [default: the nearest]")
]
Throttle = Annotated[
    float | None, typer.Option(help="Held open loop, 0 to 1 [default: 0.2]", show_default=False)
]
Speed = Annotated[
    float | None,
    typer.Option(help="Drive at this speed, m/s, slower in bends [default: hold the throttle]"),
]
Traffic = Annotated[int, typer.Option(help="Other cars, 0 to 12.")]
Light = Annotated[str, typer.Option(help="clear, overcast, dusk, fog, heavy-shadow, rain or snow.")]
DriveSeed = Annotated[int, typer.Option(help="Of traffic, light and scenery.", min=0)]
TracksDir = Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")]

DemoFolder = Annotated[Path, typer.Option(help="Folder for all results.")]
Rounds = Annotated[int, typer.Option(help="Rounds to collect.", min=12)]
FramesARound = Annotated[int, typer.Option(help="Frames a round.", min=20)]
Minutes = Annotated[float, typer.Option(help="Training time.", min=0.1)]
FirstDrive = Annotated[
    bool,
    typer.Option("--first-drive", help="Stop after the first drive, a film of the shipped model."),
]
DemoSeed = Annotated[int, typer.Option(help="Of the collection and the training.", min=0)]


@app.callback()
def controllers() -> None:
    """Drive the simulated car with a controller, on the true state or on a model's perception."""


@app.command()
def drive(
    controller: ControllerName = DRIVE.controller,
    track: Track = DRIVE.track,
    lanes: Lanes = DRIVE.lanes,
    perception: Perception = DRIVE.perception,
    steps: Steps = DRIVE.steps,
    log: Log = DRIVE.log,
    video: Video = DRIVE.video,
    watch: Watch = DRIVE.watch,
    latency_ms: Latency = DRIVE.latency_ms,
    drop: Drop = DRIVE.drop,
    realtime: Realtime = DRIVE.realtime,
    parameters: Parameters = DRIVE.parameters,
    model: Model = DRIVE.model,
    start_d: StartD = DRIVE.start_d,
    target_lane: TargetLane = DRIVE.target_lane,
    throttle: Throttle = DRIVE.throttle,
    speed: Speed = DRIVE.speed,
    traffic: Traffic = DRIVE.traffic,
    light: Light = DRIVE.light,
    seed: DriveSeed = DRIVE.seed,
    tracks_dir: TracksDir = DRIVE.tracks_dir,
    as_json: command.AsJson = False,
) -> None:
    """Drive closed loop from 25 m before the line, at rest, and print the score.

    Gear 1 and the throttle are held, except behind slower traffic; with --speed, the speed. The
    score is the sum of the rewards over the steps requested; leaving the track, turning round,
    rolling backwards or a collision ends the drive.
    """
    config = DriveConfig(
        controller=controller,
        track=track,
        lanes=lanes,
        perception=perception,
        steps=steps,
        log=log,
        video=video,
        watch=watch,
        latency_ms=latency_ms,
        drop=drop,
        realtime=realtime,
        parameters=parameters,
        model=model,
        start_d=start_d,
        target_lane=target_lane,
        throttle=throttle,
        speed=speed,
        traffic=traffic,
        light=light,
        seed=seed,
        tracks_dir=tracks_dir,
    )
    result = _drive_with_progress(config)
    if result.slowed_steps:
        _stderr().print(
            f"perception was lost for more than 1 s: the car slowed down for "
            f"{result.slowed_steps} steps",
            highlight=False,
        )
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        _print_table(config, result)


@app.command()
def demo(
    out: DemoFolder = DEMO.out,
    rounds: Rounds = DEMO.rounds,
    frames: FramesARound = DEMO.frames,
    minutes: Minutes = DEMO.minutes,
    seed: DemoSeed = DEMO.seed,
    first_drive: FirstDrive = DEMO.first_drive,
    as_json: command.AsJson = False,
) -> None:
    """The shipped model on a first drive, then the whole pipeline: collect, train, evaluate, serve,
    predict, drive, and an HTML report.

    The same command continues where it was stopped. Exit 1 when a limit is missed.
    """
    from controllers.demo.process import stop_on_sigterm
    from controllers.demo.report import check_limits, print_tables, write_report
    from controllers.demo.run import announce, run_demo

    stop_on_sigterm()
    config = DemoConfig(
        out=out, rounds=rounds, frames=frames, seed=seed, minutes=minutes, first_drive=first_drive
    )
    announce(config)
    result = run_demo(config)
    if first_drive:
        if as_json:
            typer.echo(json.dumps(result.as_json()))
        return
    found = check_limits(result)
    report = write_report(config, result)
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        print_tables(found, result.asked)
        typer.echo(f"report: {report}")
    missed = [one.what for one in found if not one.reached]
    if missed:
        command.fail(
            f"the limit is missed for {', '.join(missed)}; a slower machine needs more --minutes "
            "(with another --out)"
        )


app.command()(compare_cli.compare)
app.command()(compare_cli.tune)
app.command()(train)
app.command()(record)


def _drive_with_progress(config: DriveConfig) -> "DriveResult":
    from rich.markup import escape

    from controllers.drive import check_started, drive

    with command.progress_bar() as bar:
        task = bar.add_task(escape(f"{config.controller} on {config.track}"), total=None)
        result = drive(config, lambda done, total: bar.update(task, completed=done, total=total))
    check_started(config, result)
    return result


def _stderr() -> "Console":
    from rich.console import Console

    return Console(stderr=True)


def _print_table(config: DriveConfig, result: "DriveResult") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{config.controller} on {config.track}, perception {config.perception}"
    table = Table(title=escape(title))
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in result.as_json().items():
        table.add_row(name, escape(_cell(value)))
    Console().print(table)
    for name, path in (("log", config.log), ("film", config.video)):
        if path is not None:
            typer.echo(f"{name}: {path}")


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    if isinstance(value, list):
        return " to ".join(_cell(part) for part in value)
    return "-" if value is None else str(value)


def main() -> None:
    command.main(app)

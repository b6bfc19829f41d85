"""Controllers at the wheel. Run: `controllers drive --controller lqr --track oval`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime import cli as command

if TYPE_CHECKING:
    from rich.console import Console

    from controllers.closed_loop import DriveResult
    from controllers.drive import DriveConfig

app = typer.Typer(add_completion=False, rich_markup_mode="rich", no_args_is_help=True)


@app.callback()
def controllers() -> None:
    """Drive the simulated car with a controller, on the truth or on what a model perceives."""


@app.command()
def drive(
    controller: Annotated[
        str, typer.Option(help="lqr, or torcs: the reference laps' law.")
    ] = "lqr",
    track: Annotated[str, typer.Option(help="Its name (`simulator tracks`) or file.")] = "oval",
    lanes: Annotated[int, typer.Option(help="1, 2 or 3.")] = 1,
    perception: Annotated[
        str, typer.Option(help="truth, model, or a service such as http://127.0.0.1:8000")
    ] = "truth",
    steps: Annotated[
        int | None, typer.Option(help="Control steps of 50 ms [default: about one lap]")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Write the drive to this CSV file.")] = None,
    model: Annotated[str, typer.Option(help="Run for perception model.")] = "default",
    start_d: Annotated[
        float | None, typer.Option(help="Start this far left of the track's centre, m.")
    ] = None,
    target_lane: Annotated[
        int | None, typer.Option(help="Lane to follow, 0 the leftmost [default: the nearest]")
    ] = None,
    throttle: Annotated[float, typer.Option(help="Held open loop, 0 to 1.")] = 0.2,
    traffic: Annotated[int, typer.Option(help="Other cars, 0 to 12.")] = 0,
    light: Annotated[str, typer.Option(help="clear, overcast, dusk, fog, heavy-shadow.")] = "clear",
    seed: Annotated[int, typer.Option(help="Of traffic, light and scenery.", min=0)] = 0,
    tracks_dir: Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Drive closed loop from 25 m before the line, at rest, and score it.

    Gear 1 and the throttle are held, but for slower traffic ahead. The score is a sum over the
    steps asked for; leaving the track, turning round or a collision ends the drive.
    """
    from rich.markup import escape
    from rich.progress import MofNCompleteColumn, Progress

    from controllers.drive import DriveConfig
    from controllers.drive import drive as drive_trip

    config = DriveConfig(
        controller=controller,
        track=track,
        lanes=lanes,
        perception=perception,
        steps=steps,
        log=log,
        model=model,
        start_d=start_d,
        target_lane=target_lane,
        throttle=throttle,
        traffic=traffic,
        light=light,
        seed=seed,
        tracks_dir=tracks_dir,
    )
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=_stderr(), transient=True) as bar:
        task = bar.add_task(escape(f"{controller} on {track}"), total=None)
        result = drive_trip(
            config, lambda done, total: bar.update(task, completed=done, total=total)
        )
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        _show(config, result)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for all that comes of it.")] = Path("demo"),
    rounds: Annotated[int, typer.Option(help="Rounds to collect.", min=12)] = 100,
    frames: Annotated[int, typer.Option(help="Frames a round.", min=20)] = 200,
    minutes: Annotated[float, typer.Option(help="Training time.", min=0.1)] = 8.5,
    seed: Annotated[int, typer.Option(help="Of the collection and the training.", min=0)] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """The whole pipeline: collect, train, evaluate, serve, ask, drive, and an HTML report.

    The same command again goes on where it was stopped. Exit 1 when the model misses a limit.
    """
    from controllers.demo.process import stop_on_sigterm
    from controllers.demo.report import verdicts, write_report
    from controllers.demo.run import DemoConfig, run_demo
    from controllers.demo.tables import print_tables

    stop_on_sigterm()
    config = DemoConfig(out=out, rounds=rounds, frames=frames, seed=seed, minutes=minutes)
    result = run_demo(config)
    found = verdicts(result.evaluation)
    report = write_report(config, result)
    if as_json:
        typer.echo(json.dumps(result.as_json()))
    else:
        print_tables(found, result.asked)
        typer.echo(f"report: {report}")
    missed = [one.what for one in found if not one.reached]
    if missed:
        command.fail(
            f"the model misses the limit for {', '.join(missed)}; a slower machine needs more "
            "--minutes (with another --out)"
        )


def _stderr() -> "Console":
    from rich.console import Console

    return Console(stderr=True)


def _show(config: "DriveConfig", result: "DriveResult") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    title = f"{config.controller} on {config.track}, perception {config.perception}"
    table = Table(title=escape(title))
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in result.as_json().items():
        table.add_row(name, escape(_shown(value)))
    Console().print(table)
    if config.log is not None:
        typer.echo(f"log: {config.log}")


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    if isinstance(value, list):
        return " to ".join(_shown(part) for part in value)
    return "-" if value is None else str(value)


def main() -> None:
    command.main(app)

"""The commands `controllers compare` and `controllers tune`."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from controllers.config import CompareConfig, TuneConfig
from runtime import cli as command

COMPARE, TUNE = CompareConfig(), TuneConfig()
TERMINAL_WIDTH = 120  # columns that the tables need

CompareOut = Annotated[Path, typer.Option(help="Folder for results.json and report.html.")]
Tracks = Annotated[str, typer.Option(help="Names or files, with commas between them.")]
Controllers = Annotated[
    str, typer.Option(help="Names, MODULE:CLASS or FILE.py:CLASS, with commas between them.")
]
Perceptions = Annotated[
    str, typer.Option(help="truth, model or addresses of services, with commas between them.")
]
Seeds = Annotated[int, typer.Option(help="Drives of each kind, with seeds 0, 1, ...")]
Disturb = Annotated[
    bool,
    typer.Option(
        "--disturb",
        help="Also with sensor noise, delay, wind, and another friction, mass and tyre stiffness.",
    ),
]
Steps = Annotated[
    int | None, typer.Option(help="Control steps of 50 ms [default: the paper's, else about a lap]")
]
StartD = Annotated[
    float | None,
    typer.Option(help="Start, m left of the centre [default: -width/6, TORCS's grid]"),
]
Latency = Annotated[float, typer.Option(help="The perception's answers come this late.")]
Drop = Annotated[float, typer.Option(help="Share of the answers that are lost.")]
Model = Annotated[str, typer.Option(help="Run for perception model.")]
Light = Annotated[str, typer.Option(help="clear, overcast, dusk, fog, heavy-shadow, rain or snow.")]
Parameters = Annotated[
    Path | None, typer.Option(help="Parameters of controllers, written by `controllers tune`.")
]
TracksDir = Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")]
TuneOut = Annotated[Path, typer.Option(help="File of the parameters found.")]
Tunable = Annotated[str, typer.Option(help="Names, with commas between them.")]
Budget = Annotated[int, typer.Option(help="Drives on each track, the same for each controller.")]
Reward = Annotated[str, typer.Option(help="paper, or quadratic: the paper's second reward.")]
TuneDisturbance = Annotated[
    str, typer.Option(help="none, noise, delay, wind, friction, mass or stiffness.")
]
Seed = Annotated[int, typer.Option(help="Of the candidates and the disturbance.", min=0)]


def compare(
    out: CompareOut = COMPARE.out,
    tracks: Tracks = COMPARE.tracks,
    controllers: Controllers = COMPARE.controllers,
    perceptions: Perceptions = COMPARE.perceptions,
    seeds: Seeds = COMPARE.seeds,
    disturb: Disturb = COMPARE.disturb,
    steps: Steps = COMPARE.steps,
    start_d: StartD = COMPARE.start_d,
    latency_ms: Latency = COMPARE.latency_ms,
    drop: Drop = COMPARE.drop,
    model: Model = COMPARE.model,
    light: Light = COMPARE.light,
    parameters: Parameters = COMPARE.parameters,
    tracks_dir: TracksDir = COMPARE.tracks_dir,
    as_json: command.AsJson = False,
) -> None:
    """Drive every controller on every track and print the paper's table.

    One lane, standing start, throttle 0.2 in gear 1. The same command goes on where it was stopped:
    a drive whose result is in the folder is not driven again.
    """
    from rich.markup import escape

    from controllers.compare.report import write_report
    from controllers.compare.run import compare as run

    config = CompareConfig(
        out=out,
        tracks=tracks,
        controllers=controllers,
        perceptions=perceptions,
        seeds=seeds,
        disturb=disturb,
        steps=steps,
        start_d=start_d,
        latency_ms=latency_ms,
        drop=drop,
        model=model,
        light=light,
        parameters=parameters,
        tracks_dir=tracks_dir,
    )
    with command.progress_bar() as bar:
        task = bar.add_task("", total=None)
        content = run(
            config,
            lambda done, total, name, share: bar.update(
                task, completed=done + share, total=total, description=escape(name)
            ),
        )
    report = write_report(config.out, content)
    if as_json:
        typer.echo(json.dumps(content))
    else:
        _print_scores(content)
        typer.echo(f"report: {report}")


def tune(
    out: TuneOut = TUNE.out,
    controllers: Tunable = TUNE.controllers,
    tracks: Tracks = TUNE.tracks,
    budget: Budget = TUNE.budget,
    reward: Reward = TUNE.reward,
    steps: Steps = TUNE.steps,
    disturbance: TuneDisturbance = TUNE.disturbance,
    seed: Seed = TUNE.seed,
    tracks_dir: TracksDir = TUNE.tracks_dir,
    as_json: command.AsJson = False,
) -> None:
    """Search the parameters of controllers, with the same budget of drives for each.

    `controllers drive` and `controllers compare` take the file with --parameters. The same command
    goes on where it was stopped.
    """
    from rich.markup import escape

    from controllers.compare.tune import tune as run

    config = TuneConfig(
        out=out,
        controllers=controllers,
        tracks=tracks,
        budget=budget,
        reward=reward,
        steps=steps,
        disturbance=disturbance,
        seed=seed,
        tracks_dir=tracks_dir,
    )
    with command.progress_bar() as bar:
        task = bar.add_task("", total=None)
        content = run(
            config,
            lambda done, total, name: bar.update(
                task, completed=done, total=total, description=escape(name)
            ),
        )
    if as_json:
        typer.echo(json.dumps(content))
        return
    for name, found in content["controllers"].items():
        values = ", ".join(f"{key} {value:.4g}" for key, value in found["parameters"].items())
        typer.echo(
            f"{name}: {found['reward']:.5f} a step, untuned {found['untuned']:.5f}; "
            f"{values or 'its own parameters'}"
        )
    typer.echo(f"parameters: {out}")


def _print_scores(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from controllers.compare.report import score_table
    from controllers.compare.run import groups

    console = Console()
    console = Console(width=max(console.width, TERMINAL_WIDTH))
    for (perception, disturbance), drives in groups(content):
        head, rows = score_table(drives)
        table = Table(title=escape(f"score a step; perception {perception}, {disturbance} added"))
        for title in head:
            table.add_column(escape(title), justify="left" if title == "track" else "right")
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)

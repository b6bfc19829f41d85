"""The command `datagen`: collect, verify and describe datasets.

datagen collect --rounds 60 --out datasets/default
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from datagen.cli.collect import DEFAULT_FOLDER, collect, merge
from datagen.cli.inspect import export, stats, view
from datagen.cli.maintain import recover, split
from runtime import cli as command
from runtime.cli import AsJson, counted, print_result
from trackfeatures.errors import UserError

app = typer.Typer(
    help="Record driver-view images with their track features, and check what was recorded.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A dataset folder.")]


app.command()(collect)
app.command()(merge)


@app.command()
def verify(
    folder: Folder = DEFAULT_FOLDER,
    level: Annotated[
        str,
        typer.Option(
            help="quick: ends and counts. full: every byte. deep: every image and label decoded."
        ),
    ] = "full",
    replay: Annotated[
        int, typer.Option(help="Also simulate so many rounds again: labels must be bit-equal.")
    ] = 0,
    pixels: Annotated[
        bool, typer.Option("--pixels", help="With --replay: images too, on the same renderer.")
    ] = False,
    tracks_dir: Annotated[
        Path | None, typer.Option(help="With --replay: folder of TORCS tracks.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check that a dataset is what was recorded; exit 1 when it is not."""
    from rich.console import Console

    from datagen.recording.integrity.round_checks import LEVELS
    from datagen.recording.integrity.verify import verify as run

    if level not in LEVELS:
        raise UserError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    with Console(stderr=True).status(f"checking {folder}") as status:
        report = run(folder, level, lambda name: status.update(f"checked {name}"))
        replayed: list[str] = []
        if replay and report.ok:
            from datagen.recorder.replay import replay as simulate

            replayed, found = simulate(
                folder, replay, tracks_dir, pixels, lambda name: status.update(f"replayed {name}")
            )
            report = replace(report, ok=not found, problems=tuple(found))
    verdict = "in order" if report.ok else counted(len(report.problems), "problem")
    there = f"{counted(report.rounds, 'round')}, {counted(report.frames, 'frame')}"
    again = f", {len(replayed)} replayed" if replayed else ""
    line = f"{folder}: {there}, level {level}{again}: {verdict}"
    content = {**report.as_json(), "replayed": replayed}
    print_result(content, as_json, "\n".join([line, *report.problems, *report.recovered]))
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def info(folder: Folder = DEFAULT_FOLDER, as_json: AsJson = False) -> None:
    """Count what is in a dataset, and say what always answering the mean would miss by."""
    from datagen.cli.inspect import text
    from datagen.recording.dataset import Dataset
    from datagen.recording.statistics import describe

    statistics = describe(Dataset.open(folder))
    print_result(statistics, as_json, text(statistics))


app.command()(recover)
app.command()(split)
app.command()(view)
app.command()(stats)
app.command()(export)


def main() -> None:
    command.main(app)

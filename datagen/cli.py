"""The command `datagen`: collect, verify and describe datasets.

datagen collect --rounds 60 --out datasets/default
"""

import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from trackfeatures import command
from trackfeatures.errors import UserError

DEFAULT_FOLDER = Path("datasets/default")

app = typer.Typer(
    help="Record driver-view images with their track features, and check what was recorded.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A dataset folder.")]


@app.command()
def collect(
    rounds: Annotated[int, typer.Option(help="How many rounds.")] = 60,
    frames: Annotated[int, typer.Option(help="Frames a round, 20 a second.")] = 2000,
    out: Annotated[Path, typer.Option(help="Dataset folder; an unfinished one is finished.")] = (
        DEFAULT_FOLDER
    ),
    seed: Annotated[int, typer.Option(help="Everything random comes from it.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core.")] = 0,
    tracks: Annotated[str, typer.Option(help="Names or files, by commas; empty: a choice.")] = "",
    lanes: Annotated[str, typer.Option(help="Lane counts, by commas.")] = "1,2,3",
    lights: Annotated[str, typer.Option(help="Lights, by commas; empty: all.")] = "",
    tracks_dir: Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")] = None,
    split_test_share: Annotated[float, typer.Option(help="Share of rounds for testing.")] = 0.25,
    codec: Annotated[str, typer.Option(help="jpeg (quality 95) or png (lossless).")] = "jpeg",
    as_json: AsJson = False,
) -> None:
    """Let the scripted driver drive and record rounds; the same command again goes on."""
    from datagen.collect import collect as run
    from datagen.plan import LIGHTS, Wanted, make_plan
    from datagen.progress import shown
    from datagen.tracks import choose_tracks

    wanted = Wanted(
        rounds=rounds,
        frames=frames,
        seed=seed,
        tracks=choose_tracks(_names(tracks), tracks_dir),
        lanes=_numbers(lanes),
        lights=_names(lights) or LIGHTS,
        test_share=split_test_share,
        codec=codec,
    )
    plan = make_plan(wanted)
    try:
        with shown(rounds, rounds * frames) as progress:
            result = run(plan, out, workers or os.cpu_count() or 1, tracks_dir, progress)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: finished rounds are kept; the same command goes on\n")
        raise typer.Exit(command.INTERRUPTED) from None
    line = (
        f"{result.out}: {_counted(result.rounds, 'round')}, "
        f"{_counted(result.frames, 'frame')}; recorded "
        f"{result.recorded_frames} in {result.seconds:.1f} s, "
        f"{result.frames_per_second:.0f} a second"
    )
    _print(result.as_json(), as_json, line)


@app.command()
def verify(
    folder: Folder = DEFAULT_FOLDER,
    level: Annotated[
        str,
        typer.Option(
            help="quick: ends and counts. full: every byte. deep: every image and label decoded."
        ),
    ] = "full",
    as_json: AsJson = False,
) -> None:
    """Check that a dataset is what was recorded; exit 1 when it is not."""
    from rich.console import Console

    from datagen.recording.check import LEVELS
    from datagen.recording.verify import verify as run

    if level not in LEVELS:
        raise UserError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    with Console(stderr=True).status(f"checking {folder}") as status:
        report = run(folder, level, lambda name: status.update(f"checked {name}"))
    verdict = "in order" if report.ok else _counted(len(report.problems), "problem")
    found = f"{_counted(report.rounds, 'round')}, {_counted(report.frames, 'frame')}"
    line = f"{folder}: {found}, level {level}: {verdict}"
    _print(report.as_json(), as_json, "\n".join([line, *report.problems]))
    if not report.ok:
        raise typer.Exit(1)


@app.command()
def info(folder: Folder = DEFAULT_FOLDER, as_json: AsJson = False) -> None:
    """Count what is in a dataset, and say what always answering the mean would miss by."""
    from datagen.recording.dataset import Dataset
    from datagen.recording.statistics import describe
    from datagen.report import text

    statistics = describe(Dataset.open(folder))
    _print(statistics, as_json, text(statistics))


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(sorted({int(part) for part in _names(text)}))
    except ValueError as error:
        raise UserError(
            f"--lanes is {text!r}; give numbers with commas between, as 1,2,3"
        ) from error


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _print(content: dict[str, Any], as_json: bool, line: str) -> None:
    sys.stdout.write(f"{json.dumps(content, indent=1) if as_json else line}\n")


def main() -> None:
    command.main(app)

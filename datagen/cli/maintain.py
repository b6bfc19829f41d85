"""The commands that check and repair datasets: `datagen verify`, `recover` and `split`.

datagen verify datasets/default --level full
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datagen.cli.inspect import DatasetFolder
from datagen.planning.config import DATASET_FOLDER, CollectConfig
from runtime.cli import AsJson, counted, print_result
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recording.integrity.verify import Report
    from datagen.recording.near_duplicates import Tolerances

Level = Annotated[
    str,
    typer.Option(
        help="What is checked. quick: the end of each file and the number of its messages; "
        "full: every byte; deep: every byte, and every image and label is decoded."
    ),
]
Replay = Annotated[
    int,
    typer.Option(
        help="Number of rounds to simulate again. The check fails if a simulated label or state "
        "of the car differs in any byte from the recorded one. Only for datasets of `datagen "
        "collect` and `datagen protocol`."
    ),
]
Pixels = Annotated[
    bool,
    typer.Option(
        "--pixels",
        help="With --replay: the images must be equal, too. They are equal only if this machine "
        "has the renderer (graphics driver and device) with which the dataset was recorded.",
    ),
]
TracksDir = Annotated[
    Path | None,
    typer.Option(
        help="With --replay: further folder in which tracks are looked up. Default: none."
    ),
]


def verify(
    folder: DatasetFolder = DATASET_FOLDER,
    level: Level = "full",
    replay: Replay = 0,
    pixels: Pixels = False,
    tracks_dir: TracksDir = None,
    as_json: AsJson = False,
) -> None:
    """Check that a dataset is unchanged since it was recorded; if it is not, the exit code is 1."""
    from rich.console import Console
    from rich.markup import escape

    from datagen.recording.integrity.round_checks import LEVELS
    from datagen.recording.integrity.verify import verify as run

    if level not in LEVELS:
        raise UserError(f"there is no level {level!r}; choose {', '.join(LEVELS)}")
    if pixels and not replay:
        raise UserError("--pixels compares images that are rendered again; give --replay N, too")
    if tracks_dir is not None and not replay:
        raise UserError("--tracks-dir has the tracks of --replay; give --replay N, too")
    with Console(stderr=True).status(f"checking {escape(str(folder))}") as status:
        report = run(folder, level, lambda name: status.update(f"checked {name}"))
        replayed: list[str] = []
        if replay and report.ok:
            from datagen.recorder.replay import replay as simulate

            replayed, problems = simulate(
                folder, replay, tracks_dir, pixels, lambda name: status.update(f"replayed {name}")
            )
            report = replace(report, ok=not problems, problems=tuple(problems))
    _print_report(report, folder, level, replayed, as_json)
    if not report.ok:
        raise typer.Exit(1)


def _print_report(
    report: "Report", folder: Path, level: str, replayed: list[str], as_json: bool
) -> None:
    verdict = "in order" if report.ok else counted(len(report.problems), "problem")
    contents = f"{counted(report.rounds, 'round')}, {counted(report.frames, 'frame')}"
    again = f", {len(replayed)} replayed" if replayed else ""
    line = f"{folder}: {contents}, level {level}{again}: {verdict}"
    result = {**asdict(report), "replayed": replayed}
    print_result(result, as_json, "\n".join([line, *report.problems, *report.recovered]))


def recover(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File of the damaged round (.mcap).")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write. Default: a new file in the folder of FILE, or in "
            "DIR/recovered if FILE is in DIR/rounds. DIR/rounds/ID.mcap makes the file a round of "
            "the dataset DIR; then run the command that made the dataset again, which lists the "
            "round as recovered in the split."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Copy the intact frames of a damaged round to a new file, marked as recovered."""
    from datagen.recording.integrity.recover import recover as run

    done = run(file, out)
    least = "at least " if done.at_least else ""
    line = f"{done.out}: {counted(done.saved, 'frame')} saved, {least}{done.lost} lost"
    print_result(asdict(done), as_json, line)


SplitName = Annotated[
    str,
    typer.Option(
        help="Name of the split, which is the file DIR/splits/NAME.json: letters, digits, '.', "
        "'_' and '-'. The other commands use the split `default`; to use another split, copy its "
        "file over DIR/splits/default.json and run the command that made the dataset again."
    ),
]
Near = Annotated[
    str,
    typer.Option(
        help="Largest differences between near-duplicates, as three numbers separated by commas: m "
        "along the road, m across the road, degrees of the angle to the road."
    ),
]


def split(
    folder: DatasetFolder,
    name: SplitName = "default",
    by: Annotated[
        str,
        typer.Option(
            help="Create the split. round: rounds are assigned at random; track: tracks are "
            "assigned at random, and all rounds of a track are on the same side. Default: "
            "check the existing split."
        ),
    ] = "",
    test_share: Annotated[
        float | None,
        typer.Option(
            help="With --by: share of the rounds that are kept for testing, 0 to 1.",
            show_default=str(CollectConfig.test_share),
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="With --by: seed of the random assignment, 0 or more.", show_default="0"),
    ] = None,
    with_recovered: Annotated[
        bool,
        typer.Option(
            "--with-recovered",
            help="With --by: also assign the rounds that `datagen recover` wrote.",
        ),
    ] = False,
    near: Near = "0.5,0.1,0.5",
    as_json: AsJson = False,
) -> None:
    """Check a split of a dataset into rounds for training and for testing, or create one with --by.

    The sides of a split are train, test and unseen (rounds on tracks that are kept for tests). A
    split in which the same round, seed or content is on two sides is refused. The command counts
    the frames of test and unseen that have a near-duplicate in train: a frame of the same track
    and light at a similar position and angle to the road. An existing split is not overwritten.
    Rounds that are unseen in the split default, or in the plan if there is no split default, stay
    unseen.
    """
    from datagen.recording.split_report import SplitConfig, check_split, format_report, make_split

    tolerances = _tolerances(near)
    if by:
        share = CollectConfig.test_share if test_share is None else test_share
        make_split(folder, name, SplitConfig(by, share, seed or 0, with_recovered))
    elif test_share is not None or seed is not None or with_recovered:
        raise UserError(
            "--test-share, --seed and --with-recovered belong to --by, which creates a split"
        )
    report = check_split(folder, name, tolerances, made=bool(by))
    print_result(report.as_json(), as_json, format_report(report))


def _tolerances(text: str) -> "Tolerances":
    from datagen.recording.near_duplicates import Tolerances

    try:
        s, offset, yaw = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--near is {text!r}; give three numbers, such as 0.5,0.1,0.5") from error
    if not all(0.0 < value < float("inf") for value in (s, offset, yaw)):
        raise UserError(f"--near is {text!r}; give numbers above 0")
    return Tolerances(s, offset, yaw)

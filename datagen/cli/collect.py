"""The commands `datagen collect` and `datagen merge`.

datagen collect --rounds 60 --out datasets/default
"""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from datagen.planning.config import DATASET_FOLDER, UNSEEN_FOLDER, CollectConfig, all_lights
from datagen.recording.names import UNSEEN
from runtime import cli as command
from runtime.cli import AsJson, counted, print_result
from runtime.options import options_of
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.execution.progress import CollectResult
    from datagen.planning.plan import Plan, Shard
    from datagen.recorder.record import MakeLaw

    ClassShares = dict[str, dict[str, float]]

DEFAULT_LANES = ",".join(map(str, CollectConfig.lanes))
PIPE_WIDTH = 120  # width of tables in characters if stdout is not a terminal

Out = Annotated[
    Path | None,
    typer.Option(
        help="Dataset folder to write; an unfinished dataset in it is continued. Default: "
        f"{DATASET_FOLDER}, or {UNSEEN_FOLDER} with --split unseen."
    ),
]
Workers = Annotated[int, typer.Option(help="Number of processes that record; 0: one per CPU core.")]
Tracks = Annotated[
    str,
    typer.Option(
        help="Names or files of the tracks to record, separated by commas; random: a random "
        "road in each round. Default: all tracks of the project and of TORCS except the "
        "four unseen tracks (coast, countryside, dirt-3, e-track-4); with --split "
        "unseen, the unseen tracks."
    ),
]
Lanes = Annotated[
    str,
    typer.Option(
        help="Numbers of lanes of the roads, 1 to 3, separated by commas; each round has one of "
        "these numbers."
    ),
]
Lights = Annotated[
    str,
    typer.Option(
        help="Kinds of light and weather, separated by commas, from: clear, overcast, dusk, "
        "fog, heavy-shadow, rain, snow; empty (the default): all."
    ),
]
TracksDir = Annotated[
    Path | None, typer.Option(help="Further folder in which tracks are looked up. Default: none.")
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Camera file of driverview, OpenCV, ROS or Kalibr; the images are recorded with "
        "the lens of this file, and with its position and angles on the car if it "
        "contains them. Default: the camera of the shipped models.",
    ),
]
ShardOf = Annotated[
    str,
    typer.Option(
        help="Part of the plan to record, as NUMBER/COUNT, for example 2/4 for the second of four "
        "parts. The parts may be recorded into one shared folder, or into folders of their own, "
        "which `datagen merge` joins. Default: the whole plan."
    ),
]
ExecutorName = Annotated[
    str,
    typer.Option(
        help="Where the rounds are recorded: local (processes on this machine) or ray (the "
        "Ray cluster at $RAY_ADDRESS; if the variable is not set, a new one on this "
        "machine)."
    ),
]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Print the plan (the list of all rounds) and record nothing."),
]


@options_of(CollectConfig, make=dict)
def collect(
    values: dict[str, Any],
    out: Out = None,
    workers: Workers = 0,
    tracks: Tracks = "",
    lanes: Lanes = DEFAULT_LANES,
    lights: Lights = "",
    tracks_dir: TracksDir = None,
    camera: CameraFile = None,
    shard: ShardOf = "",
    executor: ExecutorName = "local",
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Record a dataset: a program, the scripted driver, drives the simulated car.

    A dataset consists of rounds. A round is one recorded drive, with its images and labels in one
    file. To continue an interrupted dataset, run the same command again.
    """
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.plan import Shard
    from datagen.planning.planner import make_plan
    from datagen.planning.summary import expected_classes
    from datagen.planning.tracks import choose_tracks
    from runtime.camera_file import read_camera
    from trackfeatures.camera import CameraParameters

    config = CollectConfig(
        **values,
        tracks=choose_tracks(names(tracks), tracks_dir, unseen=values["split"] == UNSEEN),
        lanes=numbers(lanes),
        lights=names(lights) or all_lights(),
        camera=CameraParameters() if camera is None else read_camera(camera, CameraParameters()),
    )
    part = Shard.parse(shard) if shard else None
    forecast = TrackForecast.of(config.tracks, tracks_dir)
    plan = make_plan(config, forecast)
    classes = expected_classes(plan, forecast)
    if dry_run:
        _print_plan(plan, classes, as_json)
        return
    folder = out or (UNSEEN_FOLDER if config.split else DATASET_FOLDER)
    result = record_plan(plan, classes, folder, workers, tracks_dir, executor, part)
    print_recorded(result, as_json)


def print_recorded(result: "CollectResult", as_json: bool) -> None:
    """Print the result of a collection as a line or as JSON."""
    line = (
        f"{result.out}: {counted(result.rounds, 'round')}, "
        f"{counted(result.frames, 'frame')}; recorded "
        f"{result.recorded_frames} in {result.seconds:.1f} s, "
        f"{result.frames_per_second:.0f} a second"
    )
    print_result(asdict(result), as_json, line)


def _print_plan(plan: "Plan", classes: "ClassShares", as_json: bool) -> None:
    from rich.console import Console

    from datagen.planning.summary import listing, overview

    if as_json:
        print_result({**plan.as_json(), "expected_classes": classes}, True, "")
        return
    console = Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)
    console.print(listing(plan), overview(plan, classes))


def record_plan(
    plan: "Plan",
    classes: "ClassShares",
    folder: Path,
    workers: int,
    tracks_dir: Path | None,
    executor: str,
    shard: "Shard | None",
    make_law: "MakeLaw | None" = None,
) -> "CollectResult":
    """Record the rounds of `plan`, or only those of its part `shard`, into `folder`. Show a
    progress bar and return the totals.

    `classes` are the forecast shares of the classes of the road, for the table above the bar.
    `workers` is the number of recording processes; 0 means one per core. `executor` is "local" or
    "ray". `make_law` creates a steering law in place of the default one. Exits with code 130 after
    Ctrl-C.
    """
    from datagen.execution.collect import collect as run
    from datagen.execution.progress import frames_of, progress_bar
    from datagen.planning.summary import overview
    from datagen.recording.folder import read_states

    rounds = plan.rounds if shard is None else shard.select(plan.rounds)
    frames = sum(frames_of(rounds, read_states(folder)).values())
    try:
        with progress_bar(len(rounds), frames, overview(plan, classes)) as progress:
            return run(
                plan,
                folder,
                workers,
                tracks_dir,
                progress,
                executor=executor,
                shard=shard,
                make_law=make_law,
            )
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: finished rounds are kept; the same command continues\n")
        raise typer.Exit(command.INTERRUPTED) from None


def merge(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Dataset folders to merge."),
    ],
    out: Annotated[Path, typer.Option(help="Dataset folder to create, or to add the rounds to.")],
    as_json: AsJson = False,
) -> None:
    """Copy the rounds of several datasets into one dataset.

    The datasets are parts of one plan (`datagen collect --shard`), or datasets in which no two
    rounds have the same name or seed. If several datasets have the same round, an undamaged one is
    copied; if all are recovered, the one with the most frames.
    """
    from datagen.execution.merge import merge as run

    merged = run(folders, out)
    line = f"{out}: {merged.rounds} of {counted(merged.planned, 'round')} of the plan"
    print_result(asdict(merged), as_json, line)


def names(text: str) -> tuple[str, ...]:
    """Split `text` at its commas into names without surrounding spaces; leave out empty names."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def numbers(text: str) -> tuple[int, ...]:
    """Return the lane counts in `text` in ascending order. `text` is the value of --lanes, numbers
    separated by commas. Raises UserError for a part that is not a number."""
    try:
        return tuple(sorted({int(part) for part in names(text)}))
    except ValueError as error:
        raise UserError(
            f"--lanes is {text!r}; give numbers separated by commas, such as 1,2,3"
        ) from error

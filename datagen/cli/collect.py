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
PIPE_WIDTH = 120  # characters: width of tables if stdout is no terminal

Out = Annotated[
    Path | None,
    typer.Option(
        help="Dataset folder; an unfinished dataset is continued. "
        f"Default: {DATASET_FOLDER}, or {UNSEEN_FOLDER} with --split unseen."
    ),
]
Workers = Annotated[int, typer.Option(help="Recording processes; 0: one per core.")]
Tracks = Annotated[
    str,
    typer.Option(
        help="Names or files of tracks, separated by commas; empty: all but the held-out tracks."
    ),
]
Lanes = Annotated[str, typer.Option(help="Numbers of lanes, separated by commas.")]
Lights = Annotated[
    str,
    typer.Option(
        help="Lights, separated by commas, from: clear, overcast, dusk, fog, heavy-shadow, rain, "
        "snow; empty: all."
    ),
]
TracksDir = Annotated[Path | None, typer.Option(help="A further folder to search for tracks.")]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Camera file of driverview, OpenCV, ROS or Kalibr: record with its lens and mount.",
    ),
]
ShardOf = Annotated[
    str, typer.Option(help="Part of the plan, for batch systems: 2/4 is the second of four.")
]
ExecutorName = Annotated[
    str,
    typer.Option(
        help="local: processes of this machine. ray: the Ray cluster at $RAY_ADDRESS, or a new one."
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan; record nothing.")]


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
    """Record rounds with the scripted driver; the same command continues an interrupted dataset."""
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
    """Record the plan, or its part `shard`, into `folder`, show a progress bar and return the
    totals.

    `classes` are the forecast shares of the classes of the road, for the table above the bar.
    `make_law` creates a steering law in place of the default one. Exits with code 130 after Ctrl-C.
    """
    from datagen.execution.collect import collect as run
    from datagen.execution.progress import progress_bar
    from datagen.planning.summary import overview

    rounds = plan.rounds if shard is None else shard.select(plan.rounds)
    frames = sum(entry.frames for entry in rounds)
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
        list[Path], typer.Argument(metavar="DIR...", help="Dataset folders to merge.")
    ],
    out: Annotated[Path, typer.Option(help="Dataset folder to create or to add to.")],
    as_json: AsJson = False,
) -> None:
    """Merge datasets, such as the shards of one plan, into one dataset."""
    from datagen.execution.merge import merge as run

    merged = run(folders, out)
    line = f"{out}: {merged.rounds} of {counted(merged.planned, 'round')} of the plan"
    print_result(asdict(merged), as_json, line)


def names(text: str) -> tuple[str, ...]:
    """Split `text` at its commas into names without surrounding spaces; leave out empty names."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def numbers(text: str) -> tuple[int, ...]:
    """Return the lane counts in `text`, the value of --lanes, in ascending order. Raises UserError
    if a part is no number."""
    try:
        return tuple(sorted({int(part) for part in names(text)}))
    except ValueError as error:
        raise UserError(
            f"--lanes is {text!r}; give numbers separated by commas, such as 1,2,3"
        ) from error

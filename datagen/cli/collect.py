"""The commands `datagen collect` and `datagen merge`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from runtime import cli as command
from runtime.cli import AsJson, counted, print_result
from trackfeatures.errors import UserError

DEFAULT_FOLDER = Path("datasets/default")
UNSEEN_FOLDER = Path("datasets/unseen")
FREQUENCY_HZ = 20
STRETCH = 1  # frames: neighbours that look alike are one picture to a network


def collect(
    rounds: Annotated[int, typer.Option(help="How many rounds.")] = 60,
    frames: Annotated[int, typer.Option(help="Frames a round.")] = 2000,
    frequency: Annotated[
        int, typer.Option(help="Frames a second; the car is steered 20 times a second or more.")
    ] = FREQUENCY_HZ,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Dataset folder; an unfinished one is finished. "
            f"Default: {DEFAULT_FOLDER}, or {UNSEEN_FOLDER} with --split unseen."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Everything random comes from it.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core.")] = 0,
    tracks: Annotated[str, typer.Option(help="Names or files, by commas; empty: a choice.")] = "",
    lanes: Annotated[str, typer.Option(help="Lane counts, by commas.")] = "1,2,3",
    lights: Annotated[str, typer.Option(help="Lights, by commas; empty: all.")] = "",
    stretch: Annotated[
        int, typer.Option(help="Frames until another scenery's turn; 0: a round shows one.")
    ] = STRETCH,
    scenes: Annotated[
        int, typer.Option(help="Sceneries a round, shown in turn; 0: one for every 200 frames.")
    ] = 0,
    tracks_dir: Annotated[Path | None, typer.Option(help="Folder of TORCS tracks.")] = None,
    split_test_share: Annotated[float, typer.Option(help="Share of rounds for testing.")] = 0.25,
    split: Annotated[
        str, typer.Option(help="unseen: rounds of a track that no training plan has.")
    ] = "",
    codec: Annotated[str, typer.Option(help="jpeg (quality 95) or png (lossless).")] = "jpeg",
    jitter_camera: Annotated[
        bool,
        typer.Option("--jitter-camera", help="Vary height, pitch and lens from round to round."),
    ] = False,
    shard: Annotated[
        str, typer.Option(help="2/4: only the second of four parts, for batch systems.")
    ] = "",
    executor: Annotated[
        str, typer.Option(help="local, or ray: on the cluster of $RAY_ADDRESS, or on this machine.")
    ] = "local",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan; record and touch nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Let the scripted driver drive and record rounds; the same command again goes on."""
    from rich.console import Console

    from datagen.execution.collect import collect as run
    from datagen.execution.progress import shown
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.config import CollectConfig, all_lights
    from datagen.planning.plan import Shard
    from datagen.planning.planner import make_plan
    from datagen.planning.summary import expected_classes, listing, overview
    from datagen.planning.tracks import choose_tracks
    from datagen.recording.splits import UNSEEN

    wanted = CollectConfig(
        rounds=rounds,
        frames=frames,
        seed=seed,
        frequency_hz=frequency,
        tracks=choose_tracks(_names(tracks), tracks_dir, unseen=split == UNSEEN),
        lanes=_numbers(lanes),
        lights=_names(lights) or all_lights(),
        stretch=stretch,
        scenes=scenes,
        test_share=split_test_share,
        codec=codec,
        jitter_camera=jitter_camera,
        split=split,
    )
    part = Shard.parse(shard) if shard else None
    forecast = TrackForecast.of(wanted.tracks, tracks_dir)
    plan = make_plan(wanted, forecast)
    classes = expected_classes(plan, forecast)
    if dry_run:
        if as_json:
            print_result({**plan.as_json(), "expected_classes": classes}, True, "")
        else:
            # A pipe has no width of its own.
            Console(width=None if sys.stdout.isatty() else 120).print(
                listing(plan), overview(plan, classes)
            )
        return
    folder = out or (UNSEEN_FOLDER if split else DEFAULT_FOLDER)
    mine = plan.rounds if part is None else part.select(plan.rounds)
    try:
        with shown(len(mine), len(mine) * frames, overview(plan, classes)) as progress:
            result = run(
                plan,
                folder,
                workers,
                tracks_dir,
                progress,
                executor=executor,
                shard=part,
            )
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: finished rounds are kept; the same command goes on\n")
        raise typer.Exit(command.INTERRUPTED) from None
    line = (
        f"{result.out}: {counted(result.rounds, 'round')}, "
        f"{counted(result.frames, 'frame')}; recorded "
        f"{result.recorded_frames} in {result.seconds:.1f} s, "
        f"{result.frames_per_second:.0f} a second"
    )
    print_result(result.as_json(), as_json, line)


def merge(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of shards.")],
    out: Annotated[Path, typer.Option(help="Dataset folder to make, or to go on with.")],
    as_json: AsJson = False,
) -> None:
    """Put the rounds that shards recorded into folders of their own together."""
    from datagen.execution.merge import merge as run

    merged = run(folders, out)
    line = f"{out}: {merged.rounds} of {counted(merged.planned, 'round')} of the plan"
    print_result(merged.as_json(), as_json, line)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(sorted({int(part) for part in _names(text)}))
    except ValueError as error:
        raise UserError(
            f"--lanes is {text!r}; give numbers with commas between, as 1,2,3"
        ) from error

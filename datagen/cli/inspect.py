"""The commands that show a dataset or hand it on: `datagen view`, `stats`, `export`.

datagen view datasets/default/rounds/round-000.mcap
datagen stats datasets/default --out stats.html
datagen export datasets/default --format webdataset --out shards
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

import trackfeatures as tf
from datagen.recording.splits import SIDES, UNSEEN
from runtime.cli import AsJson, counted, print_result

DEFAULT_FOLDER = Path("datasets/default")


def stats(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A dataset folder.")
    ] = DEFAULT_FOLDER,
    out: Annotated[
        Path | None, typer.Option(help="The page to write; else stats.html in the dataset folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a page of distributions, balance, concerns and sample frames."""
    from datagen.recording.dataset import Dataset
    from datagen.recording.statistics import describe
    from datagen.stats.concerns import concerns
    from datagen.stats.page import page
    from runtime.files import atomic_write, check_folder

    dataset = Dataset.open(folder)
    path = out or folder / "stats.html"
    check_folder(path)
    atomic_write(path, page(dataset))
    statistics = describe(dataset)
    found = concerns(statistics, dataset.rounds)
    line = f"{path}: {counted(statistics['frames'], 'frame')}, {counted(len(found), 'concern')}"
    result = {"page": str(path), "concerns": found, **statistics}
    print_result(result, as_json, "\n".join([line, *found]))


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A dataset folder.")
    ] = DEFAULT_FOLDER,
    kind: Annotated[
        str,
        typer.Option(
            "--format", help="webdataset: tar shards. lerobot: a LeRobotDataset v3.0 (parquet)."
        ),
    ] = "webdataset",
    out: Annotated[
        Path | None, typer.Option(help="The folder to write; else DIR-FORMAT beside the dataset.")
    ] = None,
    split: Annotated[
        str, typer.Option(help="Side to take: train, test, unseen or all, kept apart by name.")
    ] = "all",
    shard_size: Annotated[int, typer.Option(help="webdataset: frames of a shard.")] = 1000,
    shuffle: Annotated[
        bool,
        typer.Option(
            "--shuffle", help="webdataset: random order, the same each time; else by time."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write a dataset in the format of other trainers; images are copied, not encoded again."""
    from rich.console import Console

    from datagen.export.run import ExportConfig
    from datagen.export.run import export as run

    target = out or folder.resolve().with_name(f"{folder.resolve().name}-{kind}")
    wanted = ExportConfig(kind, split, shard_size, shuffle)
    with Console(stderr=True).status(f"reading {folder}") as status:
        done = run(folder, target, wanted, lambda n: status.update(f"{n:,} frames written"))
    megabytes = f"{done.bytes / 1e6:.1f} MB in {counted(done.files, 'file')}"
    line = (
        f"{target}: {counted(done.frames, 'frame')} of {counted(done.rounds, 'round')}, {megabytes}"
    )
    print_result(done.as_json(), as_json, line)


def view(
    recorded: Annotated[
        Path, typer.Argument(metavar="ROUND", help="A recorded round, such as rounds/ID.mcap.")
    ],
    html: Annotated[
        Path | None,
        typer.Option(help="Write a page with pictures, plan and plots, for any browser."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Write a file for Rerun (.rrd) instead of opening it.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve Rerun's viewer to a browser until interrupted.")
    ] = False,
    port: Annotated[
        int, typer.Option(help="With --web: the viewer's port; its data take the next one.")
    ] = 9090,
    as_json: AsJson = False,
) -> None:
    """Open a round: its pictures with true markings, the road in 3D, plots of labels and driving.

    Without an option a window of Rerun opens.
    """

    from datagen.view.contents import Contents
    from datagen.view.show import Ways, show

    def told(place: str) -> None:
        about = {"round": contents.header.id, "frames": len(contents.steps), "shown": place}
        print_result(about, as_json, f"{contents.about}\n{place}")
        sys.stdout.flush()  # a server goes on

    ways = Ways(html, save, web, port)
    ways.require_sane()
    contents = Contents.open(recorded)
    show(contents, ways, told)


# `datagen info` as text.


def text(statistics: dict[str, Any]) -> str:
    """The statistics of `datagen.recording.statistics.describe`, for people."""
    lines = [f"{statistics['rounds']} rounds, {statistics['frames']} frames"]
    for name in ("track", "lanes", "light", "traffic", "trajectory"):
        counts = statistics[f"by_{name}"]
        lines.append(f"{name + ':':<12}" + ", ".join(f"{key} {n}" for key, n in counts.items()))
    for side in SIDES:
        lines += _side(side, statistics[side])
    return "\n".join(lines)


def _side(name: str, side: dict[str, Any]) -> list[str]:
    if not side["frames"]:
        return [] if name == UNSEEN else [f"{name}: no frames"]
    classes = ", ".join(f"{kind} {share:.1%}" for kind, share in side["heading"].items())
    lines = [f"{name}: {side['frames']} frames; {classes}"]
    lines.append("  always answering the mean misses by (where active):")
    for feature in (*tf.MARKINGS, "to_lane_centre", "angle"):
        unit = "rad" if feature == "angle" else "m"
        missed, active = side["mean_deviation"][feature], side["active"][feature]
        lines.append(f"  {feature:<15} {missed:7.4f} {unit:<4} active {active:6.1%}")
    speed = side["speed_kmh"]
    lines.append(
        f"  speed {speed['min']:.0f} to {speed['max']:.0f} km/h, median {speed['median']:.0f}"
    )
    return lines

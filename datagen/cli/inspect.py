"""The commands that show and export datasets: `datagen info`, `stats`, `view`, `export`.

datagen view datasets/default/rounds/round-000.mcap
datagen stats datasets/default --out stats.html
datagen export datasets/default --format webdataset --out shards
"""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import trackfeatures as tf
from datagen.planning.config import DATASET_FOLDER
from datagen.recording.names import SIDES, UNSEEN
from runtime.cli import AsJson, counted, print_result
from trackfeatures.errors import UserError

SHARD_SIZE = 1000  # frames of a tar file of WebDataset
PORT = 9090  # default port of Rerun's viewer
DatasetFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the dataset.")]


def info(folder: DatasetFolder = DATASET_FOLDER, as_json: AsJson = False) -> None:
    """Print the contents of a dataset, and the errors of a baseline that always answers the mean
    label."""
    from datagen.recording.dataset import Dataset
    from datagen.recording.statistics import describe

    statistics = describe(Dataset.open(folder))
    print_result(statistics, as_json, _info_text(statistics))


def stats(
    folder: DatasetFolder = DATASET_FOLDER,
    out: Annotated[
        Path | None,
        typer.Option(help="HTML page to write. Default: DIR/stats.html."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write an HTML page about a dataset.

    It shows the distributions of the labels, the shares of the classes of the road, possible faults
    of the data, and sample frames.
    """
    from datagen.recording.dataset import Dataset
    from datagen.recording.statistics import describe
    from datagen.stats.page import concerns, page
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
    folder: DatasetFolder = DATASET_FOLDER,
    kind: Annotated[
        str,
        typer.Option(
            "--format",
            help="Format to write: webdataset (tar files) or lerobot (LeRobotDataset v3.0, Parquet "
            "files).",
        ),
    ] = "webdataset",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write. Default: DIR-FORMAT, for example datasets/default-webdataset."
        ),
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            help="Rounds to export, by the side of the split `default`: train, test, unseen, "
            "or all, which writes separate files for each side."
        ),
    ] = "all",
    shard_size: Annotated[
        int | None,
        typer.Option(
            help="With --format webdataset: number of frames in each tar file.",
            show_default=str(SHARD_SIZE),
        ),
    ] = None,
    shuffle: Annotated[
        bool,
        typer.Option(
            "--shuffle",
            help="With --format webdataset: write the frames in a random order, which is the "
            "same in every export, instead of in the order of time.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Convert a dataset to WebDataset or LeRobot; images are copied, not encoded again."""
    from rich.console import Console
    from rich.markup import escape

    from datagen.export.run import ExportConfig
    from datagen.export.run import export as run

    target = out or folder.resolve().with_name(f"{folder.resolve().name}-{kind}")
    if kind == "lerobot" and shard_size is not None:
        raise UserError("LeRobot's files have no fixed number of frames; leave out --shard-size")
    config = ExportConfig(kind, split, SHARD_SIZE if shard_size is None else shard_size, shuffle)
    with Console(stderr=True).status(f"reading {escape(str(folder))}") as status:
        done = run(folder, target, config, lambda n: status.update(f"{n:,} frames written"))
    megabytes = f"{done.bytes / 1e6:.1f} MB in {counted(done.files, 'file')}"
    line = (
        f"{target}: {counted(done.frames, 'frame')} of {counted(done.rounds, 'round')}, {megabytes}"
    )
    print_result(asdict(done), as_json, line)


def view(
    recorded: Annotated[
        Path,
        typer.Argument(metavar="ROUND", help="File of a recorded round, such as rounds/ID.mcap."),
    ],
    html: Annotated[
        Path | None,
        typer.Option(
            help="HTML page to write, with images, map and plots, instead of opening a window."
        ),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Rerun file (.rrd) to write instead of opening a window.")
    ] = None,
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="Show the round in the browser instead of in a window: serve Rerun's viewer "
            "until Ctrl-C.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            help="With --web: port of the viewer. The data are served on the port with the next "
            "number.",
            show_default=str(PORT),
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print the round's name, its number of frames and the place where it is shown as "
            "JSON on stdout.",
        ),
    ] = False,
) -> None:
    """Show a round: images with the true lane markings, the road in 3D, plots of labels and
    driving.

    Without --html, --save or --web, a window of the program Rerun opens.
    """
    from datagen.view.contents import Contents
    from datagen.view.show import ShowConfig, show

    def on_shown(place: str) -> None:
        result = {"round": contents.header.id, "frames": len(contents.steps), "shown": place}
        print_result(result, as_json, f"{contents.about}\n{place}")
        sys.stdout.flush()  # with --web this process continues to run

    if port is not None and not web:
        raise UserError("--port is the port of --web; give both, or none")
    config = ShowConfig(html, save, web, PORT if port is None else port)
    config.validate(recorded)
    contents = Contents.open(recorded)
    show(contents, config, on_shown)


def _info_text(statistics: dict[str, Any]) -> str:
    """Format the result of `datagen.recording.statistics.describe` as lines of text."""
    lines = [f"{statistics['rounds']} rounds, {statistics['frames']} frames"]
    for name in ("track", "lanes", "light", "traffic", "trajectory"):
        counts = statistics[f"by_{name}"]
        lines.append(f"{name + ':':<12}" + ", ".join(f"{key} {n}" for key, n in counts.items()))
    for side in SIDES:
        lines += _side_lines(side, statistics[side])
    return "\n".join(lines)


def _side_lines(name: str, side: dict[str, Any]) -> list[str]:
    if not side["frames"]:
        return [] if name == UNSEEN else [f"{name}: no frames"]
    classes = ", ".join(f"{kind} {share:.1%}" for kind, share in side["heading"].items())
    lines = [f"{name}: {side['frames']} frames; {classes}"]
    lines.append("  mean absolute error of always predicting the mean (where active):")
    for feature in (*tf.MARKINGS, "to_lane_centre", "angle"):
        unit = "rad" if feature == "angle" else "m"
        missed, active = side["mean_deviation"][feature], side["active"][feature]
        lines.append(f"  {feature:<15} {missed:7.4f} {unit:<4} active {active:6.1%}")
    speed = side["speed_kmh"]
    lines.append(
        f"  speed {speed['min']:.0f} to {speed['max']:.0f} km/h, median {speed['median']:.0f}"
    )
    return lines

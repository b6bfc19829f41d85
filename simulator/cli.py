"""The `simulator` command: tracks, centre lines, rendered views, the link server, the live view.

simulator tracks --json
simulator tracks plot forza --out forza.png
simulator centreline forza --step 1 --out forza.csv
simulator snapshot mountain-pass --out sheet.png --lanes 2
simulator link --track forza --name /driverview
simulator watch --track coast --lanes 2 --traffic 6
"""

from pathlib import Path
from typing import Annotated

import typer

from runtime import cli as command
from simulator.link.command import link
from simulator.track.cli import Lanes, TrackName, TracksDir, tracks
from simulator.watch.cli import watch

app = typer.Typer(
    help="Simulator of a car on roads with lane markings: tracks, physics, other cars, "
    "sensors and camera.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
)

app.add_typer(tracks, name="tracks")


@app.command()
def centreline(
    track: TrackName,
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    step: Annotated[
        float,
        typer.Option(help="Distance between two rows along the centre line, m, 0.01 to 1000."),
    ] = 1.0,
    tracks_dir: TracksDir = None,
) -> None:
    """Write the centre line of a track as a CSV file.

    Columns: s (distance from the start line along the centre line, m), x, y, z (position, m), ang
    (direction of the track in the x-y plane, rad), curv (curvature, 1/m, positive in a left bend).
    """
    from simulator.track.catalogue import find_track
    from simulator.track.centre_line_csv import write_centre_line

    rows = write_centre_line(find_track(track, tracks_dir), step, out)
    typer.echo(f"{out}: {rows} rows", err=True)


# Options of `snapshot`.
LaneWidth = Annotated[
    float | None,
    typer.Option(
        help="Width of the lanes, m, 2.7 to 4.5. Only with --roads paper. Default: 4.0; with "
        "--roads varied it is random."
    ),
]
Roads = Annotated[
    str,
    typer.Option(
        help="Kind of the road. paper: lanes of --lane-width and the track's own lane "
        "markings; varied: width of the lanes, shoulders, lane markings and surface "
        "are random, determined by --seed."
    ),
]
SnapshotSeed = Annotated[
    int,
    typer.Option(
        help="Seed of the scenery, the details of the light and the positions of the car.",
        min=0,
    ),
]
SnapshotTraffic = Annotated[
    int, typer.Option(help="Number of other cars ahead in each view.", min=0, max=12)
]
SnapshotLight = Annotated[
    str | None,
    typer.Option(
        help="Light and weather in all views: clear, overcast, dusk, fog, heavy-shadow, rain "
        "or snow. Default: every second view is in clear light, the remaining views are "
        "in the other kinds of light in turn."
    ),
]
View = Annotated[
    str | None,
    typer.Option(
        help="Direction of all views: front, left, right, rear, chase (from behind the car) "
        "or top (from above). Default: 14 views front, one chase and one top."
    ),
]
ImageKind = Annotated[
    str,
    typer.Option(
        help="Kind of the images: colour, depth (colours show distances) or class (colours "
        "show kinds of objects)."
    ),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        help="Camera file of driverview, OpenCV, ROS or Kalibr; the images are rendered "
        "through its lens. Default: the camera of the shipped models."
    ),
]


@app.command()
def snapshot(
    track: TrackName,
    out: Annotated[Path, typer.Option(help="PNG file to write.")],
    lanes: Lanes = 2,
    lane_width: LaneWidth = None,
    roads: Roads = "paper",
    seed: SnapshotSeed = 0,
    traffic: SnapshotTraffic = 3,
    light: SnapshotLight = None,
    view: View = None,
    kind: ImageKind = "colour",
    camera: CameraFile = None,
    tracks_dir: TracksDir = None,
) -> None:
    """Write a PNG file with 16 camera views along a track.

    On colour images the right half shows the true lane markings, drawn over the painted ones.
    """
    from runtime.camera_file import read_camera
    from simulator.camera.snapshot import write_contact_sheet
    from simulator.track.catalogue import find_track
    from simulator.varied.road import make_road
    from trackfeatures.camera import CameraParameters

    seen_by = None if camera is None else read_camera(camera, CameraParameters())
    road = make_road(find_track(track, tracks_dir), lanes, lane_width, roads, seed)
    write_contact_sheet(
        road, out, seed=seed, traffic=traffic, light=light, view=view, kind=kind, camera=seen_by
    )
    typer.echo(str(out), err=True)


app.command()(link)
app.command()(watch)


def main() -> None:
    command.main(app)

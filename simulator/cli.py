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
from simulator.track.cli import Lanes, TrackName, TracksDir, Traffic, tracks
from simulator.watch.cli import watch

app = typer.Typer(
    help="VTORCS: tracks, physics, traffic, sensors and camera.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
)

app.add_typer(tracks, name="tracks")


@app.command()
def centreline(
    track: TrackName,
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    step: Annotated[float, typer.Option(help="Distance between rows, m.")] = 1.0,
    tracks_dir: TracksDir = None,
) -> None:
    """Write a track's centre line as CSV: s, x, y, z, ang, curv (m, rad, 1/m)."""
    from simulator.track.catalogue import find_track
    from simulator.track.centre_line_csv import write_centre_line

    rows = write_centre_line(find_track(track, tracks_dir), step, out)
    typer.echo(f"{out}: {rows} rows", err=True)


@app.command()
def snapshot(
    track: TrackName,
    out: Annotated[Path, typer.Option(help="PNG file to write.")],
    lanes: Lanes = 2,
    lane_width: Annotated[
        float | None,
        typer.Option(help="Lane width, m, 2.7 to 4.5. Default: 4.0, random on varied roads."),
    ] = None,
    roads: Annotated[
        str, typer.Option(help="paper, or varied: random lanes, paint and look, by --seed.")
    ] = "paper",
    seed: Annotated[int, typer.Option(help="Seed of scenery, light and viewpoints.", min=0)] = 0,
    traffic: Traffic = 3,
    light: Annotated[
        str | None, typer.Option(help="Kind of light, such as rain. Default: all, in turn.")
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(help="front, left, right, rear, chase or top. Default: mostly front."),
    ] = None,
    kind: Annotated[str, typer.Option(help="Kind of image: colour, depth or class.")] = "colour",
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera file of driverview, OpenCV, ROS or Kalibr: render through its lens."
        ),
    ] = None,
    tracks_dir: TracksDir = None,
) -> None:
    """Write a sheet of camera views with the true markings drawn on them, or of depth or class
    images."""
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

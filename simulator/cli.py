"""The `simulator` command: lists tracks, writes centre lines, shows what a track looks like.

simulator tracks --json
simulator centreline forza --step 1 --out forza.csv
simulator snapshot mountain-pass --out sheet.png --lanes 2
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trackfeatures import LANE_WIDTH_M, command

if TYPE_CHECKING:
    from simulator.track.geometry import Track

app = typer.Typer(
    help="VTORCS: tracks, physics, traffic, sensors and camera.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
)

TrackName = Annotated[str, typer.Argument(help="Name of a track, or a .xml, .toml or .csv file.")]
TracksDir = Annotated[
    Path | None, typer.Option(help="Folder of TORCS (or .toml, .csv) tracks to look in as well.")
]


@app.command()
def tracks(
    tracks_dir: TracksDir = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List all tracks that can be driven."""
    from simulator.track.catalogue import list_tracks

    found = [describe(track) for track in list_tracks(tracks_dir)]
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        _print_table(found)


@app.command()
def centreline(
    track: TrackName,
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    step: Annotated[float, typer.Option(help="Metres between rows.")] = 1.0,
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
    lanes: Annotated[int, typer.Option(help="Number of lanes, 1 to 3.")] = 2,
    lane_width: Annotated[float, typer.Option(help="Metres, 3.0 to 4.5.")] = LANE_WIDTH_M,
    seed: Annotated[int, typer.Option(help="Fixes scenery, light and places.", min=0)] = 0,
    traffic: Annotated[int, typer.Option(help="Number of other cars.", min=0, max=12)] = 3,
    tracks_dir: TracksDir = None,
) -> None:
    """Write a contact sheet of views, the true markings drawn over them."""
    from simulator.camera.snapshot import write_contact_sheet
    from simulator.track.catalogue import find_track
    from simulator.track.road import Road

    road = Road(find_track(track, tracks_dir), lanes, lane_width)
    write_contact_sheet(road, out, seed=seed, traffic=traffic)
    typer.echo(str(out), err=True)


def describe(track: "Track") -> dict[str, str | float]:
    """What `tracks --json` says of one track; metres."""
    return {
        "name": track.name,
        "source": track.source,
        "length_m": round(track.length_m, 4),
        "width_m": track.width,
        "min_radius_m": round(track.min_radius_m, 4),
        "z_range_m": round(track.z_range_m, 4),
    }


def _print_table(found: list[dict[str, str | float]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for column in ("track", "source", "length m", "width m", "least radius m", "height range m"):
        table.add_column(column, justify="left" if column in ("track", "source") else "right")
    for row in found:
        table.add_row(
            *(f"{v:.1f}" if isinstance(v, float) else escape(str(v)) for v in row.values())
        )
    Console().print(table)


def main() -> None:
    command.main(app)

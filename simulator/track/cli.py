"""`simulator tracks`: lists tracks, plots one, or exports a random road.

simulator tracks --tracks-dir FOLDER --json
simulator tracks plot forza --out forza.png --lanes 2
simulator tracks export random:7 --out random-7.toml
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from simulator.track.geometry import Track

TrackName = Annotated[
    str,
    typer.Argument(
        help="Name of a track (`simulator tracks` lists the names), random:SEED for a random "
        "road, or a .xml, .toml or .csv file."
    ),
]
TracksDir = Annotated[
    Path | None,
    typer.Option(
        help="Further folder in which tracks are looked up: .xml files of TORCS, .toml or .csv "
        "files. Default: none."
    ),
]

Lanes = Annotated[int, typer.Option(help="Number of lanes, 1 to 3.")]
LaneWidth = Annotated[float, typer.Option(help="Width of the lanes, m, 2.7 to 4.5.")]
Traffic = Annotated[int, typer.Option(help="Number of other cars.", min=0, max=12)]

tracks = typer.Typer(rich_markup_mode="rich")


@tracks.callback(invoke_without_command=True)
def list_all(
    context: typer.Context,
    tracks_dir: TracksDir = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the list as JSON on stdout.")
    ] = False,
) -> None:
    """List all tracks that can be driven. The subcommands plot a track or export a random road."""
    if context.invoked_subcommand is not None:
        context.obj = tracks_dir
        return
    from simulator.track.catalogue import list_tracks

    found = [describe(track) for track in list_tracks(tracks_dir)]
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        _print_table(found)
        typer.echo("random:SEED, e.g. random:7, is a random road: a function of SEED", err=True)


@tracks.command()
def plot(
    context: typer.Context,
    track: TrackName,
    out: Annotated[
        Path | None,
        typer.Option(help="PNG file to write. Default: NAME.png in the working folder."),
    ] = None,
    lanes: Lanes = 1,
    tracks_dir: TracksDir = None,
) -> None:
    """Draw a track as a PNG file: its plan, and height, curvature and class of the road along the
    lap."""
    from simulator.track.catalogue import find_track
    from simulator.track.plot import write_plot
    from simulator.track.road import Road

    road = Road(find_track(track, tracks_dir or context.obj), lanes)
    out = out or Path(f"{road.track.name}.png")
    write_plot(road, out)
    typer.echo(str(out), err=True)


@tracks.command()
def export(
    road: Annotated[
        str,
        typer.Argument(
            metavar="random:SEED",
            help="Name of a random road: random: and a whole number, the seed, which determines "
            "the road; for example random:7.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="TOML file to write. Default: random-SEED.toml in the working folder."),
    ] = None,
) -> None:
    """Write a random road as a TOML file; commands accept the file's path as a track."""
    from simulator.track.random_roads.road import seed_of, write_road

    seed = seed_of(road)
    out = out or Path(f"random-{seed}.toml")
    write_road(seed, out)
    typer.echo(str(out), err=True)


def describe(track: "Track") -> dict[str, str | float]:
    """Return the entry of one track in `tracks --json`; lengths in metres."""
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

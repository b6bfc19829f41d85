"""`simulator link`: runs a server; a client in any language drives its car over shared memory.

simulator link --track forza --name /driverview
simulator link --header driverview_link.h
"""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from runtime.cli import AsJson
from runtime.options import options_of
from simulator.link.config import LinkConfig
from trackfeatures.errors import UserError

CameraSize = Annotated[
    str,
    typer.Option(
        help="Size of the camera images as WIDTHxHEIGHT in pixels, for example 280x210; none: no "
        "images."
    ),
]
Header = Annotated[
    Path | None,
    typer.Option(
        help="File to write the C header with the layout of the shared memory to; the command "
        "then ends without a server. Default: none."
    ),
]


@options_of(LinkConfig)
def link(
    config: LinkConfig, camera: CameraSize = "none", header: Header = None, as_json: AsJson = False
) -> None:
    """Run the simulator for a client in another process, written in C, Python or any other
    language.

    The client and the simulator exchange data over shared memory. A client sends a reset, then one
    command for each control step; the C header that --header writes describes them. Ctrl-C, SIGTERM
    or a client's request QUIT ends the server.
    """
    if header is not None:
        _write_header(header)
        return
    _serve(replace(config, picture=picture_size(camera)), as_json)


def _write_header(path: Path) -> None:
    from runtime.files import atomic_write
    from simulator.link.header import c_header

    atomic_write(path, c_header())


def _serve(config: LinkConfig, as_json: bool) -> None:
    from simulator.link.process import run

    summary = run(config, lambda text: typer.echo(text, err=True))
    if as_json:
        typer.echo(json.dumps(asdict(summary)))
    else:
        typer.echo(
            f"{summary.steps} steps in {summary.episodes} episodes for {summary.clients} clients, "
            f"{summary.clients_lost} of them lost; {summary.refused} commands refused"
        )


def picture_size(text: str) -> tuple[int, int]:
    """Parse "WxH" to (width, height) px, "none" to (0, 0). Raises UserError for other text."""
    if text == "none":
        return 0, 0
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"--camera is {text!r}; give a size such as 280x210, or none")
    return int(width), int(height)

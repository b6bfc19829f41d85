"""The perception service. Run: `serve`, or `serve --model runs/NAME --port 8000 --workers 2`."""

from typing import Annotated

import typer

from trackfeatures import command

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


@app.command()
def serve(
    model: Annotated[
        str,
        typer.Option(help="A run's folder or its name in runs/; 'latest'; 'default': the shipped."),
    ] = "default",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)
    ] = 8000,
    workers: Annotated[
        int, typer.Option(help="Processes, each with one engine: one a core.", min=1, max=256)
    ] = 1,
) -> None:
    """Answer driver-view images over HTTP with track features.

    The first line on stderr says which model answers, and where. Post an image with
    [bold]curl -H "Content-Type: image/jpeg" --data-binary @frame.jpg URL/features[/bold];
    the docs are at URL/docs. SIGTERM or Ctrl-C stops it.
    """
    from serve.server import ServiceConfig, run

    run(ServiceConfig(model, host, port, workers))


def main() -> None:
    command.main(app)

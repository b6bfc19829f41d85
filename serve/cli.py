"""The perception service. Run: `serve`, or `serve --model runs/NAME --port 8000 --workers 2`;
`serve reload` and `serve restart` while it runs.
"""

from pathlib import Path
from typing import Annotated

import typer

from runtime import cli as command

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


Port = Annotated[int, typer.Option(help="The running service's port.", min=1, max=65535)]
Model = Annotated[
    str, typer.Option(help="A run's folder or its name in runs/; 'latest'; 'default': the shipped.")
]
Host = Annotated[str, typer.Option(help="Address to listen on.")]
TokenFile = Annotated[
    Path | None,
    typer.Option(help="What clients must know: Authorization: Bearer. Or $DRIVERVIEW_TOKEN."),
]
Insecure = Annotated[
    bool, typer.Option("--insecure", help="Listen on an open --host without a token.")
]


@app.callback(invoke_without_command=True)
def serve(
    context: typer.Context,
    model: Model = "default",
    host: Host = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)
    ] = 8000,
    workers: Annotated[
        int, typer.Option(help="Processes, each with one engine: one a core.", min=1, max=256)
    ] = 1,
    token_file: TokenFile = None,
    insecure: Insecure = False,
    rate: Annotated[
        float, typer.Option(help="Requests a second of one other machine; 0: any.", min=0)
    ] = 200.0,
    connections: Annotated[
        int, typer.Option(help="Open connections at most.", min=1, max=65536)
    ] = 256,
    log_answers: Annotated[
        bool, typer.Option("--log-answers", help="Log answered requests too, not only refused.")
    ] = False,
) -> None:
    """Answer driver-view images over HTTP with track features.

    The first line on stderr says which model answers, and where. Post an image with
    [bold]curl -H "Content-Type: image/jpeg" --data-binary @frame.jpg URL/features[/bold];
    the docs are at URL/docs. SIGTERM or Ctrl-C stops it, SIGHUP loads the model anew.
    """
    if context.invoked_subcommand is not None:
        return
    from serve.config import Limits
    from serve.launch import ServiceConfig, read_token, run

    token = read_token(token_file)
    limits = Limits(connections=connections, rate=rate, token=token, log_answers=log_answers)
    run(ServiceConfig(model, host, port, workers, insecure, limits))


@app.command()
def reload(
    port: Port = 8000,
    model: Annotated[
        str | None, typer.Option(help="Another model than the one served; as for `serve`.")
    ] = None,
) -> None:
    """Load the model anew in the service that runs here, without losing a request.

    The new weights are loaded and checked beside the old. If they are bad, the old ones go on
    answering, and this command says why.
    """
    from serve.workers.control_socket import ask

    # Its own working folder may be another: a path is told whole.
    named = str(Path(model).resolve()) if model is not None and Path(model).is_dir() else model
    typer.echo(ask(port, "reload", named))


@app.command()
def restart(port: Port = 8000) -> None:
    """Replace the workers of the service that runs here one by one, without losing a request."""
    from serve.workers.control_socket import ask

    typer.echo(ask(port, "restart"))


@app.command()
def ray(
    model: Model = "default",
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port of Ray's proxy.", min=1, max=65535)] = 8000,
    replicas: Annotated[
        int, typer.Option(help="Engines, each with a core of the cluster.", min=1)
    ] = 1,
    token_file: TokenFile = None,
    insecure: Insecure = False,
) -> None:
    """Serve on Ray, on one machine or many: on the cluster of $RAY_ADDRESS, or on one of its own.

    Needs [bold]pip install 'driverview\\[rayserve]'[/bold]. The model's folder must be there on
    all machines.
    """
    from serve.config import Limits
    from serve.launch import check_exposure, read_token
    from trackfeatures.errors import UserError

    token = read_token(token_file)
    check_exposure(host, token, insecure)
    try:
        from serve.on_ray import RayConfig, run
    except ImportError as error:
        raise UserError(
            f"Ray Serve is not installed ({error}): pip install 'driverview[rayserve]'"
        ) from error
    run(RayConfig(model, host, port, replicas, Limits(token=token)))


def main() -> None:
    command.main(app)

"""Command line of the perception service. Run `serve`, or
`serve --model runs/NAME --port 8000 --workers 2`. `serve reload` and `serve restart` control a
running service; `serve ray` runs it on Ray.
"""

from pathlib import Path
from typing import Annotated

import typer

from runtime import cli as command
from runtime.access import check_exposure, read_token
from serve.config import Limits, ServiceConfig, check_proxies
from trackfeatures.errors import UserError

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


ServicePort = Annotated[int, typer.Option(help="Port of the running service.", min=1, max=65535)]
Model = Annotated[
    str,
    typer.Option(
        help="A run's folder, its name in runs/, 'latest', or a shipped model: 'default', or "
        "'varied' for real roads and lanes of 2.8 to 4.3 m."
    ),
]
NewModel = Annotated[
    str | None,
    typer.Option(help="Model to load, as for `serve --model`. Default: the current model again."),
]
Host = Annotated[str, typer.Option(help="Address to listen on. Default: this machine only.")]
Port = Annotated[int, typer.Option(help="Port to listen on; 0: any free port.", min=0, max=65535)]
RayPort = Annotated[int, typer.Option(help="Port of Ray's HTTP proxy.", min=1, max=65535)]
Workers = Annotated[
    int,
    typer.Option(help="Worker processes; each needs one core for its engine.", min=1, max=256),
]
Replicas = Annotated[int, typer.Option(help="Engines; each uses one core of the cluster.", min=1)]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        help="File with the token that clients must send in the header Authorization: Bearer. "
        "Default: the token in $DRIVERVIEW_TOKEN; if it is empty, no token is required."
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure", help="Serve other machines without a token, for example behind a proxy."
    ),
]
RequestRate = Annotated[
    float,
    typer.Option(
        help="Requests per second allowed from one client address, except from this machine; 0: no "
        "limit.",
        min=0,
    ),
]
Connections = Annotated[
    int, typer.Option(help="Largest number of open connections.", min=1, max=65536)
]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(
        help="Host name that is accepted in requests if there is no token, in addition to "
        "localhost and --host. Can be repeated."
    ),
]
TrustedProxy = Annotated[
    list[str] | None,
    typer.Option(
        help="Address or network of a proxy whose header X-Forwarded-For is accepted as the "
        "client's address. Can be repeated. Default: 127.0.0.1."
    ),
]
BodyMib = Annotated[
    int,
    typer.Option(help="MiB of memory for the bodies of all requests.", min=4, max=1 << 20),
]
CameraFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="NAME=FILE",
        help="Camera that requests can select with the header X-Camera: NAME; FILE is its "
        "camera.yaml. Can be repeated. Default: the model's camera only.",
    ),
]
Views = Annotated[
    int,
    typer.Option(
        help="Number of views of each image whose answers are averaged: 1; 2 (and mirrored: errors "
        "a tenth smaller); 6 (and turned left and right). The time is proportional to it."
    ),
]
LogAnswers = Annotated[
    bool, typer.Option("--log-answers", help="Log answered requests, not only refused ones.")
]


@app.callback(invoke_without_command=True)
def serve(
    context: typer.Context,
    model: Model = ServiceConfig.model,
    host: Host = ServiceConfig.host,
    port: Port = ServiceConfig.port,
    workers: Workers = ServiceConfig.workers,
    token_file: TokenFile = None,
    insecure: Insecure = False,
    rate: RequestRate = Limits.rate,
    connections: Connections = Limits.connections,
    log_answers: LogAnswers = False,
    allow_host: AllowHost = None,
    trusted_proxy: TrustedProxy = None,
    body_mib: BodyMib = Limits.body_mib,
    camera: CameraFiles = None,
    views: Views = 1,
) -> None:
    """Serve a model over HTTP: clients send driver-view images and receive track features.

    The first line on stderr shows the model and the service's URL. Send an image with
    [bold]curl -H "Content-Type: image/jpeg" --data-binary @frame.jpg URL/features[/bold].
    The API documentation is at URL/docs. SIGTERM or Ctrl-C stops the service, SIGHUP reloads the
    model.
    """
    if context.invoked_subcommand is not None:
        _check_no_options(context)
        return
    from serve.launch import run

    token = read_token(token_file)
    limits = Limits(
        connections=connections,
        rate=rate,
        token=token,
        log_answers=log_answers,
        hosts=(host, *(allow_host or ())),
        trusted_proxies=check_proxies(trusted_proxy or ()),
        body_mib=body_mib,
    )
    cameras = tuple(camera or ())
    run(ServiceConfig(model, host, port, workers, insecure, limits, cameras, views))


def _check_no_options(context: typer.Context) -> None:
    """Raise UserError for options before the name of a subcommand: they would have no effect."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "--" + name.replace("_", "-")
            command_name = context.invoked_subcommand
            raise UserError(
                f"{option} before `{command_name}` has no effect; give the options of "
                f"`serve {command_name}` after it"
            )


@app.command()
def reload(port: ServicePort = ServiceConfig.port, model: NewModel = None) -> None:
    """Load new weights into the service that runs on this machine; no request is lost.

    Every worker loads and checks the new weights while it still answers with the old ones. If the
    check fails, the old weights stay in use and this command prints the reason.
    """
    from serve.workers.control_socket import send_command

    # The service can have another working directory, so the path must be absolute.
    name = str(Path(model).resolve()) if model is not None and Path(model).is_dir() else model
    typer.echo(send_command(port, "reload", name))


@app.command()
def restart(port: ServicePort = ServiceConfig.port) -> None:
    """Replace the workers of the running service one by one; no request is lost."""
    from serve.workers.control_socket import send_command

    typer.echo(send_command(port, "restart"))


@app.command()
def ray(
    model: Model = ServiceConfig.model,
    host: Host = ServiceConfig.host,
    port: RayPort = ServiceConfig.port,
    replicas: Replicas = 1,
    token_file: TokenFile = None,
    insecure: Insecure = False,
    allow_host: AllowHost = None,
) -> None:
    """Serve on Ray: on the cluster at $RAY_ADDRESS, or on a new local cluster.

    Requires [bold]pip install 'driverview\\[rayserve]'[/bold]. The model's folder must exist on all
    machines of the cluster.
    """
    token = read_token(token_file)
    check_exposure(host, token, insecure)
    try:
        from serve.on_ray import RayConfig, run
    except ImportError as error:
        raise UserError(
            f"Ray Serve is not installed ({error}): pip install 'driverview[rayserve]'"
        ) from error
    limits = Limits(token=token, hosts=(host, *(allow_host or ())))
    run(RayConfig(model, host, port, replicas, limits))


def main() -> None:
    """Run the command `serve`."""
    command.main(app)

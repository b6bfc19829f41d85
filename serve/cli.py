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
        help="Model to serve: the folder of a training, its name in runs/, 'latest' for the "
        "newest training, or a model that is shipped with the project: 'default', or "
        "'varied' for real roads and lanes of 2.8 to 4.3 m."
    ),
]
NewModel = Annotated[
    str | None,
    typer.Option(
        help="Model to load: as for `serve --model`. Default: the name of the present model is "
        "looked up again and its files are read again."
    ),
]
Host = Annotated[
    str,
    typer.Option(
        help="Address to listen on. With the default, only this machine can reach the service. An "
        "address that other machines can reach requires a token or --insecure."
    ),
]
Port = Annotated[int, typer.Option(help="Port to listen on; 0: any free port.", min=0, max=65535)]
RayPort = Annotated[
    int, typer.Option(help="Port on which Ray's HTTP proxy listens.", min=1, max=65535)
]
Workers = Annotated[
    int,
    typer.Option(
        help="Number of worker processes, which compute answers at the same time.",
        min=1,
        max=256,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        help="Number of threads that compute an answer in each worker process. Default: 2 if "
        "there are two cores for each worker and the processor has no instructions for int8 and "
        "bf16 numbers, else 1.",
        min=1,
        max=64,
    ),
]
Replicas = Annotated[
    int,
    typer.Option(
        help="Number of replicas of the service; each uses one CPU core of the cluster.", min=1
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(
        help="File with the token that clients must send as the header Authorization: Bearer "
        "TOKEN. Default: the token in $DRIVERVIEW_TOKEN; if it is empty, no token is "
        "required."
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Allow that no token is set although other machines can reach --host, for "
        "example if a proxy protects the service.",
    ),
]
RequestRate = Annotated[
    float,
    typer.Option(
        help="Largest number of requests per second from one client (an IPv4 address or an "
        "IPv6 /64 network). Requests from a loopback address (127.0.0.1, ::1) are not limited. "
        "0: no limit.",
        min=0,
    ),
]
Connections = Annotated[
    int,
    typer.Option(
        help="Largest number of open connections of all clients together. Beyond it a new "
        "connection ends an old one, of a client with at least as many connections in the same "
        "worker process.",
        min=1,
        max=65536,
    ),
]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(
        help="Name that is accepted in the header Host of requests, in addition to localhost "
        "and --host. If a token is required, every name is accepted. Can be repeated. "
        "Default: none."
    ),
]
TrustedProxy = Annotated[
    list[str] | None,
    typer.Option(
        help="Address or network (such as 10.0.0.0/8) of a proxy. The address in the header "
        "X-Forwarded-For of its requests counts as the client's address. Can be "
        "repeated. Default: 127.0.0.1."
    ),
]
BodyMib = Annotated[
    int,
    typer.Option(
        help="Memory for the bodies of all unanswered requests together, MiB.", min=4, max=1 << 20
    ),
]
CameraFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="NAME=FILE",
        help="Further camera: a request with the header X-Camera: NAME contains an image of "
        "the camera that FILE (camera.yaml) describes. Can be repeated. Default: the "
        "model's camera only.",
    ),
]
LogAnswers = Annotated[
    bool,
    typer.Option(
        "--log-answers",
        help="Log every answered request; without this option only refused requests are logged.",
    ),
]


@app.callback(invoke_without_command=True)
def serve(
    context: typer.Context,
    model: Model = ServiceConfig.model,
    host: Host = ServiceConfig.host,
    port: Port = ServiceConfig.port,
    workers: Workers = ServiceConfig.workers,
    threads: Threads = None,
    token_file: TokenFile = None,
    insecure: Insecure = False,
    rate: RequestRate = Limits.rate,
    connections: Connections = Limits.connections,
    log_answers: LogAnswers = False,
    allow_host: AllowHost = None,
    trusted_proxy: TrustedProxy = None,
    body_mib: BodyMib = Limits.body_mib,
    camera: CameraFiles = None,
    views: command.Views = 1,
) -> None:
    """Serve a model over HTTP: clients send driver-view images and receive track features.

    The first line on stderr shows the model and the service's URL. Send an image with
    [bold]curl -H "Content-Type: image/jpeg" --data-binary @frame.jpg URL/features[/bold].
    The documentation of the API is at URL/docs. SIGTERM or Ctrl-C stops the service, SIGHUP reads
    the model's files again.
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
    run(ServiceConfig(model, host, port, workers, insecure, limits, cameras, views, threads))


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
    """Load another model, or new weights, into the service that runs on this machine; no request
    is lost.

    Every worker process loads and checks the new model while it still answers with the old one. If
    the check fails, the old model stays in use and this command prints the reason.
    """
    from serve.workers.control_socket import send_command

    # The service can have another working directory, so the path must be absolute.
    name = str(Path(model).resolve()) if model is not None and Path(model).is_dir() else model
    typer.echo(send_command(port, "reload", name))


@app.command()
def restart(port: ServicePort = ServiceConfig.port) -> None:
    """Replace the worker processes of the service that runs on this machine, one after the other;
    no request is lost."""
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
    camera: CameraFiles = None,
    views: command.Views = 1,
) -> None:
    """Serve a model over HTTP with Ray Serve.

    Ray's cluster is the cluster at $RAY_ADDRESS or, if this variable is not set, a new cluster on
    this machine.

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
    run(RayConfig(model, host, port, replicas, limits, tuple(camera or ()), views))


def main() -> None:
    """Run the command `serve`."""
    command.main(app)

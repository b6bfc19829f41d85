"""The options of the `controllers` commands, as annotated fields of their configurations.

A command's configuration is a dataclass. A field with an annotation is an option of the command, so
an option is declared once: the annotation is its help text or a `typer.Option`. Options that
several commands share are defined here. Rich reads help texts as markup and drops text in square
brackets, so a default that Typer cannot show is written as a sentence ("Default: ...").
"""

from collections.abc import Callable, Container
from dataclasses import fields
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

from typer import Context, Option

from runtime.cli import AsJson

Config = TypeVar("Config")

ControllerName = Annotated[
    str,
    "Controller: lqr, lqr-preview, lqr-paper, mpc, mpc-preview, lqr-kalman, mpc-kalman, "
    "rl, rl-residual, torcs, a folder of `controllers train`, or a class of your own as "
    "MODULE:CLASS or FILE.py:CLASS. torcs is the feedback law that drove the reference "
    "laps in the simulator TORCS.",
]
Controllers = Annotated[
    str,
    "Controllers, separated by commas; `controllers drive --help` lists them under --controller.",
]
Track = Annotated[str, "Name of a track (`simulator tracks` lists the names), or its file."]
Tracks = Annotated[
    str, "Names of tracks (`simulator tracks` lists them), or their files, separated by commas."
]
TracksDir = Annotated[Path | None, "Further folder in which tracks are looked up. Default: none."]
Steps = Annotated[
    int | None,
    "Number of control steps of 50 ms in a drive. Default: 6,500 on forza, 4,500 on "
    "alpine-2, 3,700 on eroad and 3,300 on g-track-3, as in the paper; about a lap on "
    "other tracks.",
]
MODELS = (
    'the folder of a training, its name in runs/, "latest" for the newest training, or a model '
    'that is shipped with the project: "default", or "varied" for real roads and lanes of 2.8 to '
    "4.3 m."
)
Model = Annotated[str, f"Model that answers the images with --perception model: {MODELS}"]
Views = Annotated[
    int,
    "With --perception model: number of views of each image whose answers are averaged. "
    "1: the image alone; 2: also its mirror image; 6: also both of these turned to the "
    "left and to the right.",
]
Latency = Annotated[
    float, "Time by which the answers of the model or service are late, ms, 0 to 1000."
]
Drop = Annotated[float, "Share of the answers of the model or service that are lost, 0 to below 1."]
Light = Annotated[
    str,
    "Light and weather in the images: clear, overcast, dusk, fog, heavy-shadow, rain or "
    "snow. It has no effect on a drive with --perception truth.",
]
Parameters = Annotated[
    Path | None,
    "File of `controllers tune` with parameters of the controller. Default: each "
    "controller's own parameters.",
]
Reward = Annotated[
    str,
    "Reward of each control step, which falls with the offset and with the angle to the "
    "road. paper: cos(angle) - |sin(angle)| - |d| / w, with the offset d from the centre "
    "of the track and half of the track's width w in m. quadratic: the paper's second "
    "reward, -(0.3 d^2 + angle^2 + 0.03 delta^2), with the offset d from the centre of "
    "the lane in m, the angle to the road and the angle delta of the front wheels in "
    "rad.",
]


def options(
    config: type[Config],
) -> Callable[[Callable[[Config, bool], None]], Callable[..., None]]:
    """Return a decorator that turns a function `f(configuration, as_json)` into a Typer command.

    The options of the command are the annotated fields of the dataclass `config`, with their
    defaults, and --json, a flag whose value is `as_json`.
    """

    def decorate(function: Callable[[Config, bool], None]) -> Callable[..., None]:
        @options_and_given(config)
        @wraps(function)
        def command(configuration: Config, as_json: bool, given: Container[str]) -> None:
            function(configuration, as_json)

        return command

    return decorate


def options_and_given(
    config: type[Config],
) -> Callable[[Callable[[Config, bool, Container[str]], None]], Callable[..., None]]:
    """Return a decorator like `options` for a function `f(configuration, as_json, given)`; `given`
    contains the names of the fields whose options the user has given, also with default values."""
    declared = [
        Parameter(
            one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=_option(one.type)
        )
        for one in fields(config)  # type: ignore[arg-type]  # a dataclass
        if get_origin(one.type) is Annotated
    ]
    as_json = Parameter("as_json", Parameter.KEYWORD_ONLY, default=False, annotation=AsJson)
    context = Parameter("context", Parameter.KEYWORD_ONLY, annotation=Context)

    def decorate(function: Callable[[Config, bool, Container[str]], None]) -> Callable[..., None]:
        @wraps(function)
        def command(context: Context, as_json: bool, **values: Any) -> None:
            sources = {name: context.get_parameter_source(name) for name in values}
            given = {name for name, one in sources.items() if one and one.name != "DEFAULT"}
            function(config(**values), as_json, given)

        command.__signature__ = Signature(  # type: ignore[attr-defined]
            [context, *declared, as_json]
        )
        return command

    return decorate


def _option(annotated: Any) -> Any:
    kind, about = get_args(annotated)
    return Annotated[kind, Option(help=about)] if isinstance(about, str) else annotated

"""The options of the `controllers` commands, as annotated fields of their configurations.

A command's configuration is a dataclass. A field with an annotation is an option of the command, so
an option is declared once: the annotation is its help text or a `typer.Option`. Options that
several commands share are defined here. Rich reads help texts as markup and drops text in square
brackets, so a default that Typer cannot show is written as a sentence ("Default: ...").
"""

from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

from typer import Option

from runtime.cli import AsJson

Config = TypeVar("Config")

ControllerName = Annotated[
    str,
    "Controller: lqr, lqr-preview, lqr-paper, mpc, mpc-preview, lqr-kalman, mpc-kalman, rl, "
    "rl-residual, torcs, a folder of `controllers train`, or a class of your own as MODULE:CLASS "
    "or FILE.py:CLASS.",
]
Controllers = Annotated[
    str, "Controllers, separated by commas, as in `controllers drive --controller`."
]
Track = Annotated[str, "Name of a track (`simulator tracks`), or its file."]
Tracks = Annotated[str, "Names of tracks, or their files, separated by commas."]
TracksDir = Annotated[Path | None, "A further folder to search for tracks."]
Steps = Annotated[
    int | None,
    "Control steps of 50 ms. Default: the paper's number on its tracks, about a lap on other "
    "tracks.",
]
MODELS = 'a run folder, its name in runs/, "latest", or a shipped model: "default" or "varied".'
Model = Annotated[str, f"Model to use with --perception model: {MODELS}"]
Views = Annotated[
    int,
    "Number of views of each image whose answers are averaged, with --perception model: 1; 2 (and "
    "mirrored); 6 (and turned left and right).",
]
Latency = Annotated[float, "Latency of the perception's answers, ms, 0 to 1000."]
Drop = Annotated[float, "Share of the perception's answers that are lost, 0 to below 1."]
Light = Annotated[
    str,
    "Light of the images: clear, overcast, dusk, fog, heavy-shadow, rain or snow. It has no effect "
    "on --perception truth.",
]
Parameters = Annotated[
    Path | None,
    "File written by `controllers tune`. Default: each controller's own parameters.",
]
Reward = Annotated[
    str,
    "Reward: paper, or quadratic, the paper's second reward: -(0.3 d^2 + angle^2 + 0.03 delta^2), "
    "with the offset d in m, the angle and the front wheel angle delta in rad.",
]


def options(
    config: type[Config],
) -> Callable[[Callable[[Config, bool], None]], Callable[..., None]]:
    """Return a decorator that turns a function `f(configuration, as_json)` into a Typer command.

    The options of the command are the annotated fields of the dataclass `config`, with their
    defaults, and --json, a flag whose value is `as_json`.
    """
    declared = [
        Parameter(
            one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=_option(one.type)
        )
        for one in fields(config)  # type: ignore[arg-type]  # a dataclass
        if get_origin(one.type) is Annotated
    ]
    as_json = Parameter("as_json", Parameter.KEYWORD_ONLY, default=False, annotation=AsJson)

    def decorate(function: Callable[[Config, bool], None]) -> Callable[..., None]:
        @wraps(function)
        def command(as_json: bool, **values: Any) -> None:
            function(config(**values), as_json)

        command.__signature__ = Signature([*declared, as_json])  # type: ignore[attr-defined]
        return command

    return decorate


def _option(annotated: Any) -> Any:
    kind, about = get_args(annotated)
    return Annotated[kind, Option(help=about)] if isinstance(about, str) else annotated

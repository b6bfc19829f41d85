"""Makes the fields of a configuration's dataclass options of a command: each is declared once.

A field that is an option has it in its type: `size: Annotated[int, typer.Option(help="...")] = 32`.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import MISSING, Field, fields
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, get_args, get_origin, get_type_hints

Command = Callable[..., None]


def options_of(
    config: Any, *, make: Callable[..., Any] | None = None, only_given: bool = False
) -> Callable[[Command], Command]:
    """Add the options of the dataclass `config` to a command, which takes a `config` first.

    `make` makes that first argument of the options' values; a command that computes other fields
    itself takes a `dict`. With `only_given` the dictionary has only the options that the user gave.
    The command finds the other values elsewhere; the help shows the dataclass's defaults.
    """
    types = get_type_hints(config, include_extras=True)
    added = [
        _parameter(field, types[field.name], only_given)
        for field in fields(config)
        if get_origin(types[field.name]) is Annotated
    ]

    def decorate(command: Command) -> Command:
        _, *others = signature(command, eval_str=True).parameters.values()

        @wraps(command)
        def run(**values: Any) -> None:
            own = {other.name: values.pop(other.name) for other in others}
            if only_given:
                given = {name: v for name, v in values.items() if v is not None and v is not False}
                command(given, **own)
            else:
                command((make or config)(**values), **own)

        parameters = [*added, *(o.replace(kind=Parameter.KEYWORD_ONLY) for o in others)]
        run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # read by Typer
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        return run

    return decorate


def _parameter(field: Field[Any], type_: Any, only_given: bool) -> Parameter:
    """The field as a parameter of a command; an option with a parser has the type of text."""
    kind, option = get_args(type_)
    default = Parameter.empty if field.default is MISSING else field.default
    if getattr(option, "parser", None) is not None:
        kind = str
        if isinstance(default, tuple):
            default = ",".join(map(str, default))
    if only_given:
        option = copy(option)
        stated = default not in (Parameter.empty, None) and kind is not bool
        if option.show_default is True and stated:
            option.show_default = str(default)
        kind, default = (bool, False) if kind is bool else (kind | None, None)
    return Parameter(
        field.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )

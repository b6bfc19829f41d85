"""Makes command-line options of the fields of a dataclass, so that each option is declared once.

A field becomes an option if its type contains a Typer option, for example
`size: Annotated[int, Option(help="...")] = 32`.
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
    """Return a decorator that adds the options of the dataclass `config` to a command.

    The first argument of the command is an instance of `config`, or, if `make` is given, the result
    of `make` called with the options' values. `make` is `dict` if the command computes fields that
    are no options itself. With `only_given` the first argument is a dictionary of the options that
    the user gave; the help text shows the dataclass's defaults.
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
    """Return `field`, whose type is `type_`, as a parameter of a Typer command. An option with a
    parser has the type `str`. With `only_given` the default is None (False for a flag)."""
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

"""How the commands of `datagen` give their results: one line, or JSON on stdout."""

import json
import sys
from typing import Annotated, Any

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def print_result(content: dict[str, Any], as_json: bool, line: str) -> None:
    sys.stdout.write(f"{json.dumps(content, indent=1) if as_json else line}\n")


def counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"

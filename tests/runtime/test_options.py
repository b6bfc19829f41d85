"""Options of a command from the fields of a dataclass."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.testing import CliRunner

from runtime.options import options_of


def numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


@dataclass(frozen=True)
class Config:
    out: Annotated[Path, typer.Option(help="Folder.")]
    seeds: Annotated[tuple[int, ...], typer.Option(parser=numbers, help="Seeds.")] = (1, 2)
    batch: Annotated[int, typer.Option(help="Images a step.")] = 32
    dry: Annotated[bool, typer.Option("--dry", help="Only plan.")] = False
    kept: float = 1.5


def answers(only_given: bool, *words: str) -> Any:
    app, seen = typer.Typer(), []

    @app.command()
    @options_of(Config, only_given=only_given)
    def command(config: Any, name: Annotated[str, typer.Option(help="Name.")] = "a") -> None:
        seen.append((config, name))

    done = CliRunner().invoke(app, list(words))
    return seen[0] if seen else done


def test_a_command_takes_the_dataclass_with_its_defaults() -> None:
    assert answers(False, "--out", "x") == (Config(Path("x")), "a")
    given = answers(False, "--out", "x", "--seeds", "4", "--batch", "0", "--dry", "--name", "b")
    assert given == (Config(Path("x"), (4,), 0, True), "b")


def test_a_command_that_computes_other_fields_takes_a_dictionary_of_all_options() -> None:
    app, seen = typer.Typer(), []

    @app.command()
    @options_of(Config, make=dict)
    def command(values: dict[str, Any]) -> None:
        seen.append(Config(**values, kept=2.0))

    assert CliRunner().invoke(app, ["--out", "x", "--batch", "8"]).exit_code == 0
    assert seen == [Config(Path("x"), batch=8, kept=2.0)]


def test_a_command_takes_only_the_options_that_were_given() -> None:
    assert answers(True) == ({}, "a")
    words = ("--out", "x", "--seeds", "4,5", "--batch", "0", "--dry")
    assert answers(True, *words) == (
        {"out": Path("x"), "seeds": (4, 5), "batch": 0, "dry": True},
        "a",
    )


def test_a_field_without_a_default_is_required_and_one_without_an_option_is_none() -> None:
    assert answers(False).exit_code == 2
    assert answers(False, "--out", "x", "--kept", "2").exit_code == 2
    shown = answers(False, "--help").output
    assert "1,2" in shown
    assert "Images a step." in shown

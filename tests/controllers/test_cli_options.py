"""The options of the commands: declared once, in the configuration, each with a help text."""

from dataclasses import fields
from typing import Annotated, Any, get_origin

import pytest
import typer

from controllers.cli import app
from controllers.compare.config import CompareConfig, TuneConfig
from controllers.demo.config import DemoConfig
from controllers.drive.config import DriveConfig
from controllers.record.cli import RecordConfig
from controllers.registry import CONTROLLERS
from controllers.rl.config import TrainConfig


@pytest.mark.parametrize(
    ("command", "config"),
    [
        ("drive", DriveConfig),
        ("compare", CompareConfig),
        ("tune", TuneConfig),
        ("train", TrainConfig),
        ("demo", DemoConfig),
        ("record", RecordConfig),
    ],
)
def test_the_options_of_a_command_are_the_annotated_fields(command: str, config: Any) -> None:
    found = typer.main.get_command(app).commands[command].params  # type: ignore[attr-defined]
    declared = [one for one in fields(config) if get_origin(one.type) is Annotated]
    assert [(one.name, one.default) for one in found[:-1]] == [
        (one.name, one.default) for one in declared
    ]
    assert found[-1].name == "as_json"
    assert all(one.help and one.help.endswith((".", ")")) for one in found)


def test_the_help_names_every_controller() -> None:
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    texts = {
        command: next(p.help for p in commands[command].params if p.name.startswith("controller"))
        for command in ("drive", "record", "tune")
    }
    for command in ("drive", "record"):
        names, _, _ = texts[command].removeprefix("Controller: ").partition(", a folder")
        assert names.split(", ") == list(CONTROLLERS)
    names = texts["tune"].removeprefix("Controllers, separated by commas: ").removesuffix(".")
    assert names.split(", ") == [name for name, entry in CONTROLLERS.items() if entry.tunable]

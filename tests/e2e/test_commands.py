"""Every command: fast help, light imports for help, one error line for wrong input."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from tests.typed import error_line, typed

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
PROGRAMS = ("simulator", "datagen", "mtlnet", "serve", "controllers")
HELP_LIMIT_S = 0.5
TRIES = 5
# Slow to import, or in need of system libraries; a help text needs none of them.
HEAVY = {
    "cv2", "fastapi", "google", "gymnasium", "matplotlib", "mcap", "moderngl", "numba", "numpy",
    "openvino", "pyarrow", "pybullet", "ray", "scipy", "simplejpeg", "torch", "uvicorn",
}  # fmt: skip
# Typer's own help of one command with one option: the lower bound for our commands.
MINIMAL_TYPER_APP = """
import typer
app = typer.Typer()
app.command()(lambda: None)
@app.command()
def work(amount: int = 1) -> None: "Work."
app()
"""
HELP_OF_ALL = """
import contextlib, importlib, io, json, sys
heavy, commands = set(json.loads(sys.argv[1])), json.loads(sys.argv[2])
for command in commands:
    sys.argv = [*command, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.suppress(SystemExit):
        importlib.import_module(f"{command[0]}.cli").main()
    assert "Usage" in output.getvalue(), command
    found = heavy & {name.split(".")[0] for name in sys.modules}
    assert not found, f"{' '.join(command)} --help imports {', '.join(sorted(found))}"
"""


def walk_commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield words
    for name, subcommand in getattr(command, "commands", {}).items():
        yield from walk_commands(subcommand, (*words, name))


def all_commands() -> list[tuple[str, ...]]:
    """Every command and subcommand that a user can type."""
    apps = {name: import_module(f"{name}.cli").app for name in PROGRAMS}
    return [
        words
        for name in apps
        for words in walk_commands(typer.main.get_command(apps[name]), (name,))
    ]


COMMANDS = all_commands()


@dataclass(frozen=True)
class Help:
    """The output of `--help`, and its processor time (s, user and system)."""

    text: str
    cpu_s: float


def measure_help(*command: str, limit_s: float = HELP_LIMIT_S) -> Help:
    """The best of at most `TRIES` runs of `command`; ends at the first below `limit_s`.

    Processor time and not wall time, because other work on the machine makes a command wait. That
    work also slows the processor down by sharing it, therefore the best of several runs.
    """
    best = float("inf")
    for _ in range(TRIES):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stderr is not None
        output, errors = process.stdout.read().decode(), process.stderr.read().decode()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0, errors
        best = min(best, usage.ru_utime + usage.ru_stime)
        if best < limit_s:
            break
    return Help(output, best)


@cache
def help_of(*command: str) -> Help:
    return measure_help(str(BIN / command[0]), *command[1:], "--help", limit_s=help_limit_s())


@cache
def help_limit_s() -> float:
    """More than `HELP_LIMIT_S` where typer alone takes more than half of it."""
    minimal = measure_help(sys.executable, "-c", MINIMAL_TYPER_APP, "work", "--help")
    return max(HELP_LIMIT_S, 2 * minimal.cpu_s)


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = str(BIN / arguments[0])
    return subprocess.run([program, *arguments[1:]], capture_output=True, text=True, timeout=300)


@pytest.mark.alone
@pytest.mark.parametrize("program", PROGRAMS)
def test_help_costs_half_a_second_at_most(program: str) -> None:
    """Of the program and of its command with the most options: the imports of all are the same."""
    own = [words for words in COMMANDS if words[0] == program]
    for command in ((program,), max(own, key=lambda words: len(options_of(*words)))):
        found = help_of(*command)
        assert "Usage" in found.text
        assert found.cpu_s < help_limit_s()


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_imports_nothing_heavy(program: str) -> None:
    commands = [words for words in COMMANDS if words[0] == program]
    arguments = [json.dumps(sorted(HEAVY)), json.dumps(commands)]
    done = subprocess.run(
        [sys.executable, "-c", HELP_OF_ALL, *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr


WRONG = [
    (("simulator", "centreline", "no-such-track", "--out", "x.csv"), "no-such-track"),
    (("simulator", "snapshot", "no-such-track", "--out", "x.png"), "no-such-track"),
    (("simulator", "link", "--track", "no-such-track"), "no-such-track"),
    (("datagen", "info", "no-such-folder"), "no-such-folder"),
    (("datagen", "verify", "x", "--level", "thorough"), "thorough"),
    (("datagen", "split", "no-such-folder"), "no-such-folder"),
    (("datagen", "recover", "no-such.mcap"), "no-such.mcap"),
    (("datagen", "collect", "--tracks", "no-such-track", "--out", "OUT"), "no-such-track"),
    (("mtlnet", "train", "--alpha", "0.3,0.2", "--data", "x", "--out", "OUT"), "0.3,0.2"),
    (("mtlnet", "train", "--alpha", "1,1,1", "--data", "no-such-data"), "no-such-data"),
    (("mtlnet", "evaluate", "--model", "no-such-run", "--data", "x"), "no-such-run"),
    (("mtlnet", "predict", "--model", "no-such-run", "x.png"), "no-such-run"),
    (("serve", "--model", "no-such-run"), "no-such-run"),
    (("controllers", "drive", "--track", "no-such-track"), "no-such-track"),
]


@pytest.mark.parametrize(
    ("arguments", "message"),
    WRONG,
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_wrong_input_is_one_error_line_that_names_it(
    arguments: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    filled = [str(tmp_path / "out") if a == "OUT" else a for a in arguments]
    done = typed(*filled)
    assert done.returncode == 1, done.stdout + done.stderr
    assert message in error_line(done)


@pytest.mark.parametrize("program", PROGRAMS)
def test_wrong_input_of_a_process_is_the_line_of_a_call(program: str) -> None:
    """What `typed` shows in this process is what a user sees."""
    arguments, _ = next(case for case in WRONG if case[0][0] == program)
    done, here = run(*arguments), typed(*arguments)
    assert (done.returncode, done.stdout, done.stderr) == (1, here.stdout, here.stderr)


def options_of(program: str, *subcommands: str) -> set[str]:
    command: Any = typer.main.get_command(import_module(f"{program}.cli").app)
    for name in subcommands:
        command = command.commands[name]
    return {
        "--help",
        *(name for option in command.params for name in (*option.opts, *option.secondary_opts)),
    }


def documented_commands() -> list[list[str]]:
    """The project's own commands that the README and docs/ tell a user to type."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(page.read_text() for page in pages)
    blocks = re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)
    lines = [line.split("#")[0].split() for block in blocks for line in block.splitlines()]
    return [words for words in lines if words and words[0] in PROGRAMS]


def test_the_documentation_uses_only_options_that_exist() -> None:
    commands = documented_commands()
    assert len(commands) >= 50
    for words in commands:
        subcommands = [w for w in words[1:2] if (words[0], w) in COMMANDS]
        options = options_of(words[0], *subcommands)
        for option in (word for word in words if word.startswith("--")):
            assert option.partition("=")[0] in options, f"{' '.join(words)}: no {option}"


def test_the_readmes_first_commands_are_make_demo_and_make_test() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    words = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    makes = [line for line in words if line.startswith("make ")]
    assert makes[:2] == ["make demo", "make test"]
    targets = re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert {line.split()[1] for line in makes} <= set(targets)
    assert "make test" in (ROOT / ".ci" / "run").read_text()

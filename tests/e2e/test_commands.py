"""What every command owes its user: quick help, and one clear line when something is wrong."""

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
COMMANDS = [
    ("simulator",),
    ("simulator", "tracks"),
    ("simulator", "tracks", "plot"),
    ("simulator", "centreline"),
    ("simulator", "snapshot"),
    ("simulator", "link"),
    ("simulator", "watch"),
    ("datagen",),
    ("datagen", "collect"),
    ("datagen", "verify"),
    ("datagen", "split"),
    ("datagen", "recover"),
    ("datagen", "info"),
    ("datagen", "export"),
    ("datagen", "view"),
    ("datagen", "stats"),
    ("datagen", "merge"),
    ("mtlnet",),
    ("mtlnet", "train"),
    ("mtlnet", "evaluate"),
    ("mtlnet", "predict"),
    ("serve",),
    ("controllers",),
    ("controllers", "drive"),
    ("controllers", "demo"),
]
HELP_LIMIT_S = 0.5


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = str(BIN / arguments[0])
    return subprocess.run([program, *arguments[1:]], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_comes_in_half_a_second(command: tuple[str, ...]) -> None:
    seconds = []
    for _ in range(5):  # the best of a few: other work on the machine is not the command's fault
        started = time.perf_counter()
        done = run(*command, "--help")
        seconds.append(time.perf_counter() - started)
        assert done.returncode == 0, done.stderr
        assert "Usage" in done.stdout
        if seconds[-1] < HELP_LIMIT_S:
            break
    assert min(seconds) < HELP_LIMIT_S


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("simulator", "centreline", "no-such-track", "--out", "x.csv"), "no-such-track"),
        (("simulator", "snapshot", "no-such-track", "--out", "x.png"), "no-such-track"),
        (("simulator", "link", "--track", "no-such-track"), "no-such-track"),
        (("datagen", "info", "no-such-folder"), "no-such-folder"),
        (("datagen", "verify", "x", "--level", "thorough"), "thorough"),
        (("datagen", "split", "no-such-folder"), "no-such-folder"),
        (("datagen", "recover", "no-such.mcap"), "no-such.mcap"),
        (("datagen", "collect", "--tracks", "no-such-track", "--out", "OUT"), "no-such-track"),
        (("mtlnet", "train", "--alpha", "0.3,0.2", "--data", "x", "--out", "OUT"), "0.3,0.2"),
        (("mtlnet", "train", "--alpha", "0.3,-1,0.5", "--data", "x", "--out", "OUT"), "-1"),
        (("mtlnet", "train", "--alpha", "1,1,1", "--data", "no-such-data"), "no-such-data"),
        (("mtlnet", "evaluate", "--model", "no-such-run", "--data", "x"), "no-such-run"),
        (("mtlnet", "predict", "--model", "no-such-run", "x.png"), "no-such-run"),
        (("serve", "--model", "no-such-run"), "no-such-run"),
        (("controllers", "drive", "--track", "no-such-track"), "no-such-track"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_a_mistake_gets_one_line_that_names_it(
    arguments: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    filled = [str(tmp_path / "out") if a == "OUT" else a for a in arguments]
    done = run(*filled)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    assert said in errors[0]


def readme_commands() -> list[list[str]]:
    """The project's own commands that the README tells a user to type."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    lines = [line.split("#")[0].split() for block in blocks for line in block.splitlines()]
    programs = {command[0] for command in COMMANDS}
    return [words for words in lines if words and words[0] in programs]


def test_the_readme_uses_only_options_that_exist() -> None:
    commands = readme_commands()
    assert len(commands) >= 8
    for words in commands:
        subcommands = [w for w in words[1:2] if (words[0], w) in COMMANDS]
        shown = re.sub(r"\s+", " ", run(words[0], *subcommands, "--help").stdout)
        for option in (word for word in words if word.startswith("--")):
            assert re.search(rf"{option}\b", shown), f"{' '.join(words)}: no {option}"


def test_the_readmes_first_commands_are_make_demo_and_make_test() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    words = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    makes = [line for line in words if line.startswith("make ")]
    assert makes[:2] == ["make demo", "make test"]
    targets = re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert {line.split()[1] for line in makes} <= set(targets)
    assert "make test" in (ROOT / ".ci" / "run").read_text()

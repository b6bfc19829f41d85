"""File names: their order; names of any bytes can be printed on any terminal and used for files."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.cli import printable
from runtime.files import atomic_write, natural_key
from runtime.film import Mp4Writer
from trackfeatures.errors import UserError


@pytest.mark.parametrize(
    "names",
    [
        ["frame1.jpg", "frame2.jpg", "frame10.jpg", "frame11.jpg"],
        ["01", "1", "2", "010", "10 a", "11"],
        ["a1b2", "a1b10", "a2b1"],
        ["A1", "b1", "B2", "c1"],
        ["x", "x0", "x00", "x" + "9" * 5000, "x1" + "0" * 5000, "y"],
        ["t1", "t-1", "t-2", "t-10"],
        ["p1\u00b2", "p2\u00b2", "p10\u00b2", "p\u0661", "p\u0662"],
    ],
)  # fmt: skip
def test_names_are_in_the_order_that_people_count_in(names: list[str]) -> None:
    assert sorted({*names}, key=natural_key) == names


PROGRAM = """
import os, sys, typer
from runtime import cli
from trackfeatures.errors import UserError
name = os.fsdecode(b'caf\\xe9 \\xc3\\xa4\\x1b[2J\\n[x].jpg')
def app():
    from rich.console import Console
    from rich.table import Table
    table = Table(title="t")
    table.add_row(cli.printable(name))
    Console(markup=False).print(table, name)
    typer.echo(name)
    with cli.progress_bar() as bar:
        bar.add_task("x")
    cli.print_result({"name": name}, True, "")
    cli.print_result({}, False, name)
    raise UserError(name)
cli.main(app)
"""


@pytest.mark.parametrize(
    "changes",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "latin-1"},
        {"PYTHONIOENCODING": "utf-8"},
        {"LC_ALL": "C"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"TERM": "dumb", "NO_COLOR": "1"},
    ],
    ids=lambda changes: " ".join(changes.values()),
)
def test_any_name_is_printed_on_any_terminal(changes: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env={**os.environ, **changes}, capture_output=True
    )
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith(b"error: ")]
    assert b"\\x1b[2J\\n[x].jpg" in line
    assert b'"caf\\udce9' in done.stdout  # JSON keeps the name for `json.loads`


def test_a_message_stays_on_one_line() -> None:
    assert printable("a\nb\x1b[0m\x85c \u00e9\udce9") == "a\\nb\\x1b[0m\\x85c \u00e9\udce9"


def test_a_text_file_takes_any_name(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9.txt")
    atomic_write(path, f"{path.name} \u00e9\n")
    assert path.read_text(encoding="utf-8") == "caf\\udce9.txt \u00e9\n"


@pytest.mark.parametrize("name", [b"caf\xe9.mp4", b"a:b.mp4", b"%03d.mp4", b"-i\n#?.mp4"])
def test_a_film_of_any_name_is_written(tmp_path: Path, name: bytes) -> None:
    path = tmp_path / os.fsdecode(name)
    with Mp4Writer(path, 10.0) as film:
        for _ in range(3):
            film.write(np.zeros((64, 64, 3), np.uint8))
    plain = path.rename(tmp_path / "plain.mp4")
    assert cv2.VideoCapture(str(plain)).get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_a_film_that_a_full_disk_cut_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    film = Mp4Writer(path, 10.0)
    film.write(np.zeros((64, 64, 3), np.uint8))
    path.unlink()
    path.write_bytes(b"what the disk took")
    with pytest.raises(UserError, match=r"a\.mp4 could not be written to its end; free some"):
        film.__exit__(None)

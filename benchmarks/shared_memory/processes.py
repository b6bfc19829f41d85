"""Code that the benchmarks of the link share: it compiles the C program, starts servers as
processes and makes names of segments."""

import subprocess
import sys
import uuid
from importlib.resources import files
from pathlib import Path
from typing import Any

from simulator.link.handshake import ServerInfo
from simulator.link.layout import Mode

LINK = Path(__file__).parents[1] / "link.py"
START_S = 180.0
"""Time limit (s) for the start of a server. With an empty cache a server compiles its code
first."""
TRACK = "oval"
INFO = ServerInfo("none", 1, 4.0, 1.0, 1.0, 1.0, 1.0, 0, 20, Mode.LOCK_STEP, 0, 0, 0, (0.0,) * 19)


def fresh_name() -> str:
    return f"/drvlink-bench-{uuid.uuid4().hex[:12]}"


def compile_hammer(folder: Path) -> str:
    program = str(folder / "hammer")
    source = Path(__file__).with_name("hammer.c")
    include = f"-I{files('simulator.link').joinpath('c')}"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", "-D_GNU_SOURCE", include]
    subprocess.run(["gcc", *strict, "-o", program, str(source), "-lm"], check=True)
    return program


def start(*command: str, out: Any = subprocess.PIPE) -> "subprocess.Popen[str]":
    return subprocess.Popen(list(command), stdout=out, stderr=subprocess.PIPE, text=True)


def start_server() -> tuple[str, "subprocess.Popen[str]"]:
    name = fresh_name()
    command = [sys.executable, "-m", "simulator", "link", "--name", name, "--track", TRACK]
    return name, start(*command, out=subprocess.DEVNULL)

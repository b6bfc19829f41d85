"""Runs commands of the project with faults of the file system and the clock (`faults.c`).

A process that has imported a command forks for each run, which saves the imports. Its networks are
small ones.
"""

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path

MODULES = (
    *("datagen.execution.merge", "datagen.export.run", "datagen.recording.integrity.recover"),
    *("datagen.recording.near_duplicates", "datagen.recording.split_report", "datagen.cli"),
    *("mtlnet.evaluation.evaluate", "mtlnet.evaluation.tables", "mtlnet.export.convert"),
    *("mtlnet.train", "mtlnet.cli", "openvino", "openvino.opset13", "rich.progress"),
    "torch._dynamo",
)
"""What the commands import."""
SOURCE = Path(__file__).with_name("faults.c")
KINDS = ("nothing", "count", "kill", "full", "full once", "read-only", "clock")
PATIENCE_S = 300  # for one run


@dataclass(frozen=True)
class Fault:
    """What happens at the change number `at` (from 1) below the folder of a run."""

    kind: str = "count"
    at: int = 0
    jump_s: int = 0
    """Of the clock."""


@dataclass(frozen=True)
class Done:
    """A run that has ended. `changes`: how many it made below its folder."""

    code: int
    stdout: str
    stderr: str
    changes: int


class Plan(ctypes.Structure):
    """`struct plan` of `faults.c`."""

    _fields_ = [
        ("count", ctypes.c_long),
        ("at", ctypes.c_long),
        ("kind", ctypes.c_long),
        ("jump_s", ctypes.c_long),
        ("folder", ctypes.c_char * 4096),
    ]


def build(folder: Path) -> Path | None:
    """Compile the faults; None where there is no C compiler."""
    compiler = next((found for found in map(shutil.which, ("cc", "gcc", "clang")) if found), None)
    if compiler is None:
        return None
    library = folder / "faults.so"
    options = ["-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, "-o", str(library), str(SOURCE), "-ldl"], check=True)
    return library


class Runner:
    """Runs commands in forks of a process that has imported them."""

    def __init__(self, process: "subprocess.Popen[str]", folder: Path) -> None:
        self._process = process
        self._folder = folder

    def run(self, words: list[str], home: Path, fault: Fault | None = None) -> Done:
        """Run a command, whose faults are those of the folder `home`."""
        out, err = self._folder / "stdout", self._folder / "stderr"
        job = {
            "words": words,
            "home": str(home),
            "outputs": [str(out), str(err)],
            "fault": asdict(fault or Fault()),
        }
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        code, changes = json.loads(self._process.stdout.readline())
        return Done(code, out.read_text(), err.read_text(), changes)


@contextmanager
def runner(library: Path, folder: Path) -> Iterator[Runner]:
    """A runner, which keeps the output of commands in `folder`."""
    environment = {
        **os.environ,
        "LD_PRELOAD": str(library),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    command = [sys.executable, "-m", "tests.chaos.process", str(library)]
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield Runner(process, folder)
        finally:
            process.kill()


def main() -> None:
    """Read jobs from stdin, a line each; write exit code and number of changes."""
    loaded = ctypes.CDLL(sys.argv[1])
    loaded.fault_plan.restype = ctypes.POINTER(Plan)
    plan = loaded.fault_plan().contents
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what an import prints is no answer
    os.sched_setaffinity(
        0, {max(os.sched_getaffinity(0))}
    )  # more threads would wait for each other
    for module in MODULES:
        import_module(module)
    make_small()
    for line in sys.stdin:
        job = json.loads(line)
        process = os.fork()
        if process == 0:
            run_forked(plan, **job)
        _, status = os.waitpid(process, 0)
        plan.kind = KINDS.index("nothing")
        answers.write(json.dumps([os.waitstatus_to_exitcode(status), plan.count]) + "\n")
        answers.flush()


def run_forked(
    plan: Plan, words: list[str], home: str, outputs: list[str], fault: dict[str, int]
) -> None:
    """Run a command, and end this process."""
    signal.alarm(PATIENCE_S)
    for number, path in enumerate(outputs, 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    plan.folder, plan.count = home.encode(), 0
    plan.at, plan.jump_s = fault["at"], fault["jump_s"]
    sys.argv = words
    code = 0
    try:
        command = import_module(f"{words[0]}.cli").main
        plan.kind = KINDS.index(str(fault["kind"]))
        command()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001  # as the interpreter would
        sys.excepthook(*sys.exc_info())
        code = 99
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(code)


def make_small() -> None:
    """Networks with few filters and units, and uncertainty heads fitted in a few steps."""
    from mtlnet.architecture import ARCHITECTURES, GRID, MTL, Conv
    from mtlnet.uncertainty_fit import head, ood

    for full in (MTL, GRID):
        few = tuple(
            replace(spec, filters=8) if isinstance(spec, Conv) else spec for spec in full.features
        )
        ARCHITECTURES[full.name] = replace(full, features=few, shared=(32, 16, 16))
    head.FIT, ood.FIT = replace(head.FIT, steps=3), replace(ood.FIT, steps=3)
    head.MAX_TRAIN_FRAMES, ood.PITCH_FRAMES = 12, 6


if __name__ == "__main__":
    main()

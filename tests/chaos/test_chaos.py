"""Commands that are killed, or whose disk is full, read-only, or whose clock jumps: nothing
half-written is ever read as whole.

`make chaos` makes many of these; the tests make a few, at the moments that the seed gives.
"""

import os
import random
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.chaos.cases import CASES, UNFINISHED, Case, make_material
from tests.chaos.process import Done, Fault, Runner, build, runner

KILLS = int(os.environ.get("DRIVERVIEW_CHAOS_KILLS", "5"))
SEED = os.environ.get("DRIVERVIEW_CHAOS_SEED", "0")
LEAST = 5  # kills of any command
KILLS_FOR_ANOTHER = 5  # for each kind of fault
DISKS = ("full", "full once", "read-only")
ANEW = 0.2  # how often a killed command is completed at once, and not killed again
YEAR_S = 365 * 24 * 3600

pytestmark = [pytest.mark.slow, pytest.mark.extended]


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runner]:
    """A process that runs `datagen` and `mtlnet`."""
    folder = tmp_path_factory.mktemp("chaos")
    library = build(folder)
    if library is None:
        pytest.skip("there is no C compiler")
    with runner(library, folder) as found:
        yield found


@pytest.fixture(scope="module")
def material(commands: Runner, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands read."""
    folder = tmp_path_factory.mktemp("material")
    make_material(folder, commands)
    words = ["mtlnet", "export", "--model", str(folder / "other"), "--data", str(folder / "roads")]
    assert commands.run([*words, "--frames", "2"], folder).code == 0
    return folder


@dataclass
class Stage:
    """One command on its way: its folder, and what a reader may take from it."""

    case: Case
    commands: Runner
    material: Path
    home: Path
    complete: list[Any] = field(default_factory=list)
    """The old state and the new one."""
    changes: int = 0

    def renew(self) -> None:
        """Make the old state again."""
        shutil.rmtree(self.home, ignore_errors=True)
        self.home.mkdir()
        self.case.prepare(self.material, self.home)

    def run(self, fault: Fault | None = None) -> Done:
        """Run the command, or what continues it."""
        return self.commands.run(self.case.command(self.material, self.home), self.home, fault)

    def measure(self) -> None:
        """Run it undisturbed."""
        self.renew()
        self.complete = [self.case.look(self.home)]
        done = self.run()
        assert done.code == 0, done.stderr
        self.complete.append(self.case.look(self.home))
        assert self.complete[0] != self.complete[1]
        self.changes = done.changes

    def check(self, refusable: bool) -> None:
        """What a reader takes is a complete state."""
        found = self.case.look(self.home)
        if found is None and refusable:
            return
        if self.case.by_round and found is not None:
            old, new = ({*(state or [()])[0]} for state in self.complete)
            assert old <= {*found[0]} <= new
        else:
            assert found in self.complete

    def is_done(self) -> bool:
        """Whether a reader takes the new state."""
        return bool(self.case.look(self.home) == self.complete[1])

    def end(self) -> None:
        """Complete it without a fault; the result is that of an undisturbed run."""
        if not self.is_done():
            done = self.run()
            assert done.code == 0, done.stderr
            assert not left_over(self.home)
        assert self.is_done()
        self.renew()


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case.name)
def measured(
    request: pytest.FixtureRequest,
    commands: Runner,
    material: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Stage:
    """A command that was run undisturbed."""
    found = Stage(request.param, commands, material, tmp_path_factory.mktemp("stage") / "home")
    found.measure()
    return found


@pytest.fixture
def stage(measured: Stage) -> Stage:
    """The same with its old state."""
    measured.renew()
    return measured


def test_killed_at_any_moment(stage: Stage) -> None:
    """Also while it continues after a kill."""
    rng = random.Random(f"{SEED} {stage.case.name}")
    for _ in range(max(KILLS // stage.case.share, LEAST)):
        fault = Fault("kill", rng.randint(1, stage.changes))
        done = stage.run(fault)
        with explained(fault, done):
            assert done.code in (0, -signal.SIGKILL)
            stage.check(refusable=True)
            if done.code == 0 or stage.is_done() or rng.random() < ANEW:
                stage.end()
    stage.end()


def test_a_failing_disk(stage: Stage) -> None:
    """One line says why, and what was there before is whole."""
    rng = random.Random(f"{SEED} {stage.case.name} disk")
    for kind in [*DISKS] * others(stage.case):
        fault = Fault(kind, rng.randint(1, stage.changes))
        done = stage.run(fault)
        with explained(fault, done):
            assert done.code in (0, 1)
            assert "Traceback" not in done.stderr
            if done.code == 1:
                (line,) = (s for s in done.stderr.splitlines() if s.startswith("error: "))
                assert done.stderr.rstrip().endswith(line)
            # What could not be put in order on a disk that stays so is refused.
            stage.check(refusable=kind == "read-only" or stage.case.by_round)
            if done.code == 0 or stage.is_done() or kind == DISKS[-1]:
                stage.end()


def test_a_clock_that_jumps(stage: Stage) -> None:
    """The calendar jumps by years at most; the result is the same."""
    rng = random.Random(f"{SEED} {stage.case.name} clock")
    for _ in range(others(stage.case)):
        jump_s = rng.choice([-1, 1]) * rng.choice([2, 3600, rng.randrange(5 * YEAR_S)])
        fault = Fault("clock", rng.randint(1, stage.changes), jump_s)
        done = stage.run(fault)
        with explained(fault, done):
            assert done.code == 0
            stage.end()


@contextmanager
def explained(fault: Fault, done: Done) -> Iterator[None]:
    """Add to what fails the fault, and what the command wrote."""
    try:
        yield
    except BaseException as error:
        error.add_note(f"seed {SEED}, {fault}: exit code {done.code}\n{done.stderr}")
        raise


def others(case: Case) -> int:
    """How many faults of each other kind."""
    return max(KILLS // case.share // KILLS_FOR_ANOTHER, 1)


def left_over(home: Path) -> list[Path]:
    """The files that a complete run leaves to nobody."""
    return [p for p in home.rglob("*") if any(part in p.name for part in UNFINISHED)]

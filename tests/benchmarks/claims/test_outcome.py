"""Exit codes of benchmarks: a claim that was not measured is not reported as reached."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.claims.outcome import MISSED, NOT_MEASURED, REACHED, exit_code

ROOT = Path(__file__).parents[3]


def test_exit_codes_differ() -> None:
    assert exit_code(True) == REACHED == 0
    assert exit_code(False) == MISSED
    assert len({REACHED, MISSED, NOT_MEASURED}) == 3


@pytest.mark.parametrize(
    ("script", "message"),
    [("torcs_fit.py", "set TORCS_TRACKS"), ("peers.py", "give at least one peer")],
)
def test_a_benchmark_without_its_material_is_not_measured(script: str, message: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "TORCS_TRACKS"}
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == NOT_MEASURED, done.stderr
    assert f"not measured: {message}" in done.stderr


def test_make_bench_lists_missed_and_unmeasured_benchmarks_separately(tmp_path: Path) -> None:
    """The Makefile's own recipe, on three scripts that end with each code."""
    for name, code in (("a_reached", 0), ("b_unmeasured", 3), ("c_missed", 1)):
        script = tmp_path / "benchmarks" / f"{name}.py"
        script.parent.mkdir(exist_ok=True)
        script.write_text(f"raise SystemExit({code})")
    (tmp_path / "venv").symlink_to(Path(sys.prefix))
    (tmp_path / "Makefile").write_text((ROOT / "Makefile").read_text())
    for name in ("pyproject.toml", "requirements.lock", "ready"):  # nothing is to be installed
        (tmp_path / name).touch()

    # `make test` runs this test: its make must not take this one for a part of itself, for then
    # it would also print the folders that it enters and leaves.
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in {"MAKEFLAGS", "MAKELEVEL", "MFLAGS"}
    }

    def bench() -> subprocess.CompletedProcess[str]:
        command = ["make", "bench", "READY=ready", "BIN=venv/bin"]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
        )

    missed = bench()
    assert missed.returncode != 0
    assert missed.stdout.splitlines()[-2:] == [
        "not measured: benchmarks/b_unmeasured.py",
        "missed or failed: benchmarks/c_missed.py",
    ]
    (tmp_path / "benchmarks" / "c_missed.py").unlink()
    unmeasured = bench()
    assert unmeasured.returncode == 0, unmeasured.stderr
    assert unmeasured.stdout.splitlines()[-1] == "not measured: benchmarks/b_unmeasured.py"

"""What a machine lacks for a GPU run, and the wheels that it brings."""

import os
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import pytest

from benchmarks import gpu_run
from benchmarks.claims.outcome import NOT_MEASURED
from benchmarks.gpu import machine, wheels
from trackfeatures.errors import UserError

ROOT = Path(__file__).parents[3]


GOOD: dict[str, Any] = {
    "torch": "2.11",
    "gpu": "NVIDIA H100",
    "gpu_bytes": 8 * 10**10,
    "renderer": "NVIDIA H100/PCIe/SSE2",
    "tracks": 23,
    "torcs": True,
    "errors": {},
}


@pytest.mark.parametrize(
    ("changes", "lacks"),
    [
        ({}, []),
        ({"gpu": None}, ["gpu: torch 2.11 finds none"]),
        ({"renderer": "llvmpipe (LLVM 15.0.6, 256 bits)"}, ["egl: OpenGL draws on llvmpipe"]),
        ({"torcs": False}, ["tracks: TORCS's"]),
        ({"errors": {"egl": "no OpenGL 3.3"}, "renderer": None}, ["egl: no OpenGL 3.3"]),
        ({"errors": {"gpu": "no torch"}, "gpu": None}, ["gpu: no torch"]),
    ],
)
def test_what_a_machine_lacks(changes: dict[str, Any], lacks: list[str]) -> None:
    found = machine.missing({**GOOD, **changes})
    assert len(found) == len(lacks)
    assert all(text.startswith(start) for text, start in zip(found, lacks, strict=True))


def test_a_rehearsal_needs_no_gpu() -> None:
    software = {**GOOD, "gpu": None, "renderer": "llvmpipe"}
    assert machine.missing(software, gpu=False) == []


def test_missing_packages_are_named_before_anything_is_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert wheels.missing_packages() == []
    for name in ("simplejpeg", "google.protobuf", "absl"):
        monkeypatch.setitem(sys.modules, name, None)
    found, (lacks,) = machine.missing_at_all()
    assert found == {}
    assert lacks.startswith("packages: absl-py, protobuf, simplejpeg; bring them with --wheels")


def test_an_answer_that_is_no_json_is_an_error() -> None:
    assert machine.ask("print('{\"a\": 1}')") == {"a": 1}
    assert machine.ask("raise SystemExit('no EGL here')") == "no EGL here"
    assert machine.ask("") == "exit code 0"


def test_the_wheels_are_those_of_the_lock_and_the_checkout_has_a_version(tmp_path: Path) -> None:
    lock = (ROOT / "requirements.lock").read_text().splitlines()
    pinned = wheels.pinned()
    assert len(pinned) == 10
    assert all(f"{each} \\" in lock for each in pinned)
    with pytest.raises(UserError, match="holds no wheels"):
        wheels.install_wheels(tmp_path, tmp_path / "site")
    wheels.describe_checkout(tmp_path / "site")
    (about,) = distributions(name="driverview", path=[str(tmp_path / "site")])
    assert f'version = "{about.version}"' in (ROOT / "pyproject.toml").read_text()


def test_wheels_are_downloaded_for_the_machine_and_may_not_be_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def pip(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        (Path(command[command.index("--dest") + 1]) / "mcap.whl").write_bytes(bytes(1_000))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", pip)
    monkeypatch.setattr(sys, "argv", ["gpu_run.py", "--collect-wheels", str(tmp_path / "new")])
    assert gpu_run.main() == 0
    assert asked[0][-10:] == wheels.pinned()
    assert asked[0][asked[0].index("--python-version") + 1] == "3.12"
    assert "--only-binary=:all:" in asked[0]
    monkeypatch.setattr(wheels, "MAX_BYTES", 999)
    with pytest.raises(UserError, match=r"have 0\.0 MB, at most"):
        wheels.collect_wheels(tmp_path / "new")


def test_a_machine_that_lacks_something_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    driver = tmp_path / "10_nvidia.json"
    driver.touch()
    monkeypatch.setattr(machine, "NVIDIA_EGL", driver)
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "")
    monkeypatch.delenv("__EGL_VENDOR_LIBRARY_FILENAMES")
    for name in ("PYTHONPATH", "TORCS_TRACKS"):  # which are set for the commands of a run
        monkeypatch.setenv(name, "before")
    found = {**GOOD, "gpu": None, "torcs": False}
    monkeypatch.setattr(machine, "missing_packages", list)
    monkeypatch.setattr(machine, "describe_machine", lambda: found)
    words = ["--out", tmp_path / "out", "--work", tmp_path / "work", "--tracks", tmp_path]
    monkeypatch.setattr(sys, "argv", ["gpu_run.py", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        gpu_run.main()
    assert ended.value.code == NOT_MEASURED
    first, *lacks = capsys.readouterr().err.splitlines()
    assert first == "not measured: this machine lacks"
    assert [line.split(":")[0] for line in lacks] == ["  tracks", "  gpu"]
    assert not (tmp_path / "out").exists()
    assert os.environ["TORCS_TRACKS"] == str(tmp_path)
    assert os.environ["__EGL_VENDOR_LIBRARY_FILENAMES"] == str(driver)
    assert os.environ["PYTHONPATH"].split(os.pathsep) == [
        *(str(ROOT), str(tmp_path / "work" / "site"), "before"),
    ]

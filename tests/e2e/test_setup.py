"""`make setup` picks a Python that the lock serves; the lock serves Python 3.11 to 3.14."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def made(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run `make` in this checkout, with only the programs of `folder` on the PATH."""
    for program in ("sh", "nproc", "dirname", "echo"):
        for parent in ("/usr/bin", "/bin"):
            if (found := Path(parent) / program).exists() and not (folder / program).exists():
                (folder / program).symlink_to(found)
    command = ["/usr/bin/make", "--no-print-directory", "-C", str(ROOT), *words]
    environment = {"PATH": str(folder), "HOME": str(folder)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def put_python(folder: Path, name: str, version: tuple[int, int]) -> None:
    """A program that behaves as Python `version`, for the question that the Makefile asks."""
    code = f"import sys; sys.version_info = (*{version}, 0); exec(sys.argv[2])"
    put_program(folder / name, f'exec {sys.executable} -c "{code}" "$@"')


def put_program(path: Path, line: str) -> None:
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("installed", "chosen"),
    [
        ({"python3": (3, 13)}, "python3"),
        ({"python3": (3, 13), "python3.11": (3, 11)}, "python3.11"),
        ({"python3": (3, 10), "python3.12": (3, 12)}, "python3.12"),
        ({"python3": (3, 15), "python3.14": (3, 14), "python3.12": (3, 12)}, "python3.14"),
        ({"python3": (3, 10)}, ""),
        ({}, ""),
    ],
)
def test_setup_chooses_a_supported_python(
    installed: dict[str, tuple[int, int]], chosen: str, tmp_path: Path
) -> None:
    for name, version in installed.items():
        put_python(tmp_path, name, version)
    show = "show: ; @echo chosen=$(PYTHON)"
    done = made(tmp_path, "--eval", show, "show")
    assert done.stdout == f"chosen={chosen}\n", done.stderr


def test_a_python_without_venv_is_passed_over(tmp_path: Path) -> None:
    put_program(tmp_path / "python3.11", "echo no module named venv; exit 1")
    put_python(tmp_path, "python3.13", (3, 13))
    done = made(tmp_path, "--eval", "show: ; @echo chosen=$(PYTHON)", "show")
    assert done.stdout == "chosen=python3.13\n"


def test_setup_refuses_a_disk_without_room_before_it_installs_anything(tmp_path: Path) -> None:
    put_python(tmp_path, "python3.11", (3, 11))
    environment = tmp_path / "environment"
    done = made(tmp_path, f"VENV={environment}", "SETUP_GB=1000000", "setup")
    assert done.returncode != 0
    assert re.search(r"^error: \.venv needs 1000000 GB, but this disk has only ", done.stderr)
    assert not environment.exists()


@pytest.mark.parametrize("uv_works", [True, False])
def test_pip_installs_the_lock_if_uv_cannot(uv_works: bool, tmp_path: Path) -> None:
    put_python(tmp_path, "python3.11", (3, 11))
    for program in ("grep", "touch"):
        (tmp_path / program).symlink_to(f"/usr/bin/{program}")
    put_program(tmp_path / "ldconfig", "echo libEGL.so.1 libGL.so.1 libEGL_nvidia.so.0")
    log, environment = tmp_path / "log", tmp_path / "environment"
    (environment / "bin").mkdir(parents=True)
    put_program(environment / "bin/python", f'echo python "$@" >> {log}')
    put_program(environment / "bin/uv", f'echo uv "$@" >> {log}; exit {int(not uv_works)}')
    done = made(tmp_path, f"VENV={environment}", "setup")
    assert done.returncode == 0, done.stderr
    assert (environment / ".ready").exists()
    installs = [line for line in log.read_text().splitlines() if "requirements.lock" in line]
    assert all("--require-hashes" in line for line in installs)
    assert [line.split()[0] for line in installs] == (["uv"] if uv_works else ["uv", "python"])
    assert ("uv could not install requirements.lock" in done.stdout) is not uv_works


def test_the_lock_pins_one_version_of_each_package_for_every_python() -> None:
    """Only packages without wheels for a version are left out of it."""
    pins = re.findall(
        r"^(\S+)==(\S+)(?: ; (.+?))? \\$", (ROOT / "requirements.lock").read_text(), re.M
    )
    names = [name for name, _, _ in pins]
    assert len(names) == len(set(names)) > 200
    limited = {
        name: limit
        for name, _, marker in pins
        if (limit := "".join(re.findall(r"python_full_version < '([\d.]+)'", marker)))
        not in ("", "3.15")
    }
    assert limited == {"pybullet": "3.12", "box2d": "3.14", "backports-zstd": "3.14"}

"""Lists the packages that a GPU run needs, and downloads and installs the wheels of missing
packages."""

import importlib
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

from trackfeatures.errors import UserError

ROOT = Path(__file__).parents[2]
PACKAGES = Path(__file__).with_name("packages.toml")
PYTHON = "3.12"
MAX_BYTES = 40 * 10**6
PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014", "manylinux1")


def packages() -> dict[str, str]:
    """Return the names of the packages in `packages.toml`, by import name."""
    tables = tomllib.loads(PACKAGES.read_text(encoding="utf-8"))
    return {**tables["machine"], **tables["wheels"]}


def missing_packages() -> list[str]:
    """Return the packages of `packages.toml` that cannot be imported in this Python."""
    return [package for name, package in packages().items() if not _is_installed(name)]


def _is_installed(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ImportError:  # a parent package is missing
        return False


def pinned() -> list[str]:
    """Return the packages to download as wheels, as `name==version` with the versions of
    requirements.lock."""
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    versions = dict(re.findall(r"^([\w.-]+)==([\w.]+)", lock, re.MULTILINE))
    wheels = tomllib.loads(PACKAGES.read_text(encoding="utf-8"))["wheels"]
    return [f"{name}=={versions[name]}" for name in wheels.values()]


def collect_wheels(folder: Path) -> int:
    """Download the wheels for Python 3.12 on x86-64 into `folder`; return their size in bytes.

    Raises UserError if pip fails, or if the wheels are larger than MAX_BYTES.
    """
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    command += ["--only-binary=:all:", "--implementation", "cp", "--python-version", PYTHON]
    for platform in PLATFORMS:
        command += ["--platform", f"{platform}_x86_64"]
    command += ["--dest", str(folder), *pinned()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"pip could not download the wheels: {done.stderr.strip()}")
    size = sum(path.stat().st_size for path in folder.glob("*.whl"))
    if size > MAX_BYTES:
        raise UserError(
            f"the wheels in {folder} have {size / 1e6:.1f} MB, at most {MAX_BYTES / 1e6:.0f} are "
            "expected; give an empty folder, or shorten the list in packages.toml"
        )
    return size


def install_wheels(wheels: Path, site: Path) -> None:
    """Install the wheels into the folder `site`, without a network, and add it to sys.path.

    Raises UserError if `wheels` has none, or if pip fails.
    """
    files = sorted(wheels.glob("*.whl"))
    if not files:
        raise UserError(f"{wheels} holds no wheels; make it with --collect-wheels {wheels}")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    command += ["--no-compile", "--no-cache-dir", "--upgrade", "--target", str(site)]
    done = subprocess.run([*command, *map(str, files)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"pip could not install {wheels}: {done.stderr.strip()}")
    sys.path.insert(0, str(site))
    importlib.invalidate_caches()


def describe_checkout(site: Path) -> None:
    """Write package metadata with this checkout's version into `site`.

    `importlib.metadata` then finds the version, which is stored in recorded rounds, although the
    checkout is not installed.
    """
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    about = site / f"driverview-{version}.dist-info" / "METADATA"
    about.parent.mkdir(parents=True, exist_ok=True)
    about.write_text(f"Metadata-Version: 2.1\nName: driverview\nVersion: {version}\n")

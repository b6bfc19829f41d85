"""The built wheel in an empty environment: it holds every file, and every command works from it.

The environment has the wheel alone; its dependencies are those of the test environment, put on the
path by a .pth file, so that nothing is downloaded. In such a directory .pth files are not read: the
checkout that the test environment may have installed stays invisible.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.request
import venv
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from serve.client import Client
from tests.e2e.test_commands import COMMANDS
from trackfeatures import MARKINGS

ROOT = Path(__file__).parents[2]
PACKAGES = ("trackfeatures", "runtime", "simulator", "datagen", "mtlnet", "serve", "controllers")
pytestmark = pytest.mark.slow

# One use of every command, in an order in which each finds what the earlier ones have made.
USES = """
simulator tracks
simulator tracks plot oval
simulator tracks export random:7 --out road.toml
simulator centreline oval --out oval.csv
simulator snapshot oval --light clear --out sheet.png
simulator link --header link.h
datagen collect --rounds 4 --frames 12 --tracks oval,circuit --workers 1 --seed 3 --out data
datagen collect --rounds 2 --frames 4 --tracks oval --workers 1 --shard 1/2 --out part
datagen collect --rounds 2 --frames 4 --tracks oval --workers 1 --shard 2/2 --out part
datagen merge part --out merged
datagen verify data --level quick
datagen info data
datagen split data
datagen stats data
datagen view data/rounds/round-000.mcap --html view.html
datagen export data --out shards
datagen recover data/rounds/round-000.mcap --out recovered.mcap
mtlnet train --data data --out run --alpha 0.3,0.2,0.5 --iterations 2 --batch 4 --device cpu
mtlnet evaluate --model run --data data --split all --report report.html
mtlnet export --model run --data data --frames 4 --format onnx
mtlnet ablate --data data --out ablation --iterations 2 --dry-run
mtlnet ship --model run --out shipped
controllers drive --steps 3
controllers drive --steps 3 --perception model --model run
controllers drive --steps 3 --controller rl
controllers compare --tracks oval --controllers lqr,mpc --seeds 1 --steps 3 --out comparison
controllers tune --controllers lqr --tracks oval --budget 2 --steps 3 --out tuned.json
controllers train --track oval --steps 20 --evaluate-every 20 --out actor
controllers record --model run --rounds 2 --frames 8 --tracks oval --workers 1 --out driven
"""
SERVERS = {("simulator", "watch"), ("mtlnet", "label"), ("serve",)}
WITHOUT = {
    ("mtlnet", "predict"),  # below, on an image
    ("mtlnet", "calibrate"),  # needs a film of a drive
    ("serve", "reload"), ("serve", "restart"),  # of a running service with workers
    ("datagen", "protocol"),  # needs the tracks of TORCS
    ("serve", "ray"),  # needs Ray
    ("controllers", "demo"),  # runs the commands above, for minutes
}  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a copy of the checkout, so that the build leaves nothing in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("*.pyc"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    pip("wheel", *options, str(source))
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def commands(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the console scripts in an environment with only the wheel."""
    home = tmp_path_factory.mktemp("environment")
    venv.create(home, symlinks=True)
    python = home / "bin" / "python"
    pip("--python", str(python), "install", "--no-deps", "--no-index", str(wheel))
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    path = home / "lib" / version / "site-packages" / "dependencies.pth"
    path.write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin"


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def test_the_wheel_holds_every_file_of_the_packages(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    files = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert len(files) > 300
    assert sorted(files - packed) == []


def test_every_command_is_used_here() -> None:
    """A new command gets a line in USES."""
    lines = [tuple(line.split()) for line in USES.split("\n") if line]
    used = {words for words in COMMANDS for line in lines if line[: len(words)] == words}
    groups = {(name,) for name in PACKAGES} - SERVERS
    assert set(COMMANDS) - groups == (used - groups) | SERVERS | WITHOUT


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The working folder of all commands: later ones read what earlier ones wrote."""
    return tmp_path_factory.mktemp("used")


@pytest.mark.extended
@pytest.mark.parametrize("line", USES.strip().split("\n"))
def test_a_command_works_from_the_wheel(commands: Path, folder: Path, line: str) -> None:
    run(commands, folder, *line.split())


@pytest.mark.extended
def test_prediction_and_servers_work_from_the_wheel(commands: Path, folder: Path) -> None:
    image = save_frame(commands, folder)
    run(commands, folder, "mtlnet", "predict", "--model", "run", image.name)
    with serving(commands, folder, "simulator", "watch", "--track", "oval") as url:
        assert b"<html" in get(url)
    (folder / "pictures").mkdir()
    shutil.copy(image, folder / "pictures")
    (folder / "pictures" / "camera.yaml").write_text("width: 280\nheight: 210\n")
    with serving(commands, folder, "mtlnet", "label", "pictures", "--no-model") as url:
        assert b"<html" in get(url)
    with serving(commands, folder, "serve", "--model", "run") as url, Client(url) as client:
        client.wait_until_ready(120.0)
        assert list(client.features(image.read_bytes())["distances_m"]) == list(MARKINGS)
        for page in ("/", "/docs", "/openapi.json"):
            assert get(url + page)


def run(commands: Path, folder: Path, name: str, *arguments: str) -> str:
    done = subprocess.run(
        [str(commands / name), *arguments],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, f"{name} {' '.join(arguments)}: {done.stdout}{done.stderr}"
    return done.stdout


def save_frame(commands: Path, folder: Path) -> Path:
    """The first recorded image, read by the installed package."""
    program = (
        "from pathlib import Path\n"
        "import datagen, sys\n"
        "from datagen.recording import Dataset\n"
        "assert Path(datagen.__file__).is_relative_to(sys.prefix), datagen.__file__\n"
        "frames = Dataset.open('data').select('all')\n"
        "Path('image.jpg').write_bytes(bytes(frames.jpeg(0)))\n"
    )
    run(commands, folder, "python", "-c", program)
    return folder / "image.jpg"


@contextmanager
def serving(commands: Path, folder: Path, name: str, *arguments: str) -> Iterator[str]:
    """The address of a command that serves, which must end cleanly on SIGINT."""
    log = folder / f"{name}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(commands / name), *arguments, "--port", "0"],
            cwd=folder,
            env=environment(),
            stdout=output,
            stderr=output,
        )
    try:
        yield wait_for_address(process, log)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) in (0, 130), log.read_text()
    finally:
        process.kill()
        process.wait()


def wait_for_address(process: subprocess.Popen[bytes], log: Path) -> str:
    while process.poll() is None:
        found = re.search(r"http://127\.0\.0\.1:\d+", log.read_text())
        if found:
            return found[0]
    raise AssertionError(log.read_text())


def get(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=120) as response:
        content: bytes = response.read()
        return content

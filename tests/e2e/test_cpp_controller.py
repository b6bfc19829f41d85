"""examples/drive.cpp: a controller in C++ drives on the service's answers, over shared memory."""

import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from controllers.demo.process import free_port, running_service
from serve.config import Limits
from simulator.track.road import Road
from simulator.track.toml_track import read_toml_track
from tests.serve.conftest import FakeEngine, outputs, serving
from tests.simulator.link.conftest import fresh_name, start_server, stop

SOURCE = Path(__file__).parents[2] / "examples" / "drive.cpp"
STRICT = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
LAP_LIMIT_S = 240.0
TOKEN = "0123456789abcdef"
MAX_LINES = 105
HEAD = 'look = "countryside"\nsurface = "asphalt"\nwidth = 12.0\n'
STRAIGHT = '[[segment]]\ntype = "straight"\nlength = 40.0\n'
BEND = '[[segment]]\ntype = "bend"\nradius = 45.0\nangle = 90.0\nspiral = 20.0\n'

TWO_ADDRESSES = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <netdb.h>
#include <string.h>

typedef int look_up(const char *, const char *, const struct addrinfo *, struct addrinfo **);

int getaddrinfo(const char *host, const char *port, const struct addrinfo *hints,
                struct addrinfo **found) {
    look_up *real = (look_up *)dlsym(RTLD_NEXT, "getaddrinfo");
    if (strcmp(host, "localhost")) return real(host, port, hints, found);
    return real("::1", port, hints, found) || real("127.0.0.1", port, hints, &(*found)->ai_next);
}
"""
"""A library in which `localhost` has the addresses ::1 and 127.0.0.1, in this order."""


@pytest.fixture(scope="module")
def two_addresses(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which `localhost` has two addresses."""
    folder = tmp_path_factory.mktemp("addresses")
    (folder / "addresses.c").write_text(TWO_ADDRESSES)
    out = folder / "addresses.so"
    command = ["gcc", "-shared", "-fPIC", "-o", str(out), str(folder / "addresses.c"), "-ldl"]
    subprocess.run(command, check=True)
    return {"LD_PRELOAD": str(out)}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, compiled without a warning."""
    compiler = next((found for found in map(shutil.which, ("c++", "g++", "clang++")) if found), "")
    if not compiler:
        pytest.skip("no C++ compiler on this machine")
    out = tmp_path_factory.mktemp("cpp") / "drive"
    include = f"-I{files('simulator.link').joinpath('c')}"
    subprocess.run([compiler, *STRICT, include, "-o", str(out), str(SOURCE)], check=True)
    return out


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A square with bends of 45 m radius: a lap of about 520 m."""
    path = tmp_path_factory.mktemp("track") / "square.toml"
    path.write_text(HEAD + 4 * (STRAIGHT + BEND))
    return path


@pytest.fixture(scope="module")
def link(track: Path) -> Iterator[str]:
    """The name of a simulator with the model's camera, behind shared memory."""
    name = fresh_name()
    process = start_server(name, "--track", str(track), "--camera", "280x210")
    assert process.stderr is not None
    said = ""
    while "is ready for a client" not in said:
        line = process.stderr.readline()
        said += line
        assert line, f"the simulator did not start: {said}"
    yield name
    stop(process)


def drive(program: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    """Run the example with the arguments `words` and `more` environment variables."""
    command = [str(program), *map(str, words)]
    environment = {**os.environ, **more}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=LAP_LIMIT_S, env=environment
    )


@pytest.mark.extended
@pytest.mark.slow
def test_a_controller_in_cpp_drives_a_lap_over_http_and_shared_memory(
    program: Path, track: Path, link: str, tmp_path: Path
) -> None:
    with running_service("default", tmp_path / "serve.log") as url:
        done = drive(program, link, "127.0.0.1", url.rpartition(":")[2])
    assert (done.returncode, done.stderr) == (0, "")
    said = re.fullmatch(
        r"lap done: (\d+) steps, mean \|d\| ([\d.]+) m, largest \|d\| ([\d.]+) m\n", done.stdout
    )
    assert said is not None, done.stdout
    steps, mean, largest = int(said[1]), float(said[2]), float(said[3])
    road = Road(read_toml_track(track))
    longest_s = (road.track.length_m + 25.0) / 10.0  # a lap at 10 m/s at least
    assert 20 * road.track.length_m / 25.0 < steps < 20 * longest_s
    assert mean < 0.3
    assert mean < largest < min(1.0, road.half_width)


def test_it_says_what_is_missing(program: Path) -> None:
    assert "error: usage: drive /NAME HOST PORT" in drive(program).stderr
    done = drive(program, "driverview", "127.0.0.1", free_port())
    assert done.returncode == 1
    assert "error: no name of a link: driverview" in done.stderr


@pytest.mark.slow
def test_without_a_service_it_ends_with_one_line(program: Path, link: str) -> None:
    done = drive(program, link, "127.0.0.1", free_port())
    assert (done.returncode, done.stderr) == (1, "error: no service\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("listens", "asked"), [("::1", "::1"), ("::1", "localhost"), ("127.0.0.1", "localhost")]
)
def test_it_asks_ipv6_and_every_address_of_a_name(
    program: Path, link: str, two_addresses: dict[str, str], listens: str, asked: str
) -> None:
    """The car follows the answers: it turns left until it has left the road."""
    turn = FakeEngine(lambda _image: outputs((-2.0, 2.0, np.nan, np.nan, np.nan), 0.5))
    with serving(turn, host=listens) as service:
        done = drive(program, link, asked, service.port, **two_addresses)
    assert done.stderr == "error: the car has left the road\n"


@pytest.mark.slow
def test_it_sends_the_token_of_the_environment(program: Path, link: str) -> None:
    turn = FakeEngine(lambda _image: outputs((-2.0, 2.0, np.nan, np.nan, np.nan), 0.5))
    with serving(turn, limits=Limits(token=TOKEN)) as service:
        refused = drive(program, link, "127.0.0.1", service.port)
        done = drive(program, link, "127.0.0.1", service.port, DRIVERVIEW_TOKEN=TOKEN)
    assert "error: no answer: HTTP/1.1 401" in refused.stderr
    assert done.stderr == "error: the car has left the road\n"


@pytest.mark.slow
def test_a_service_that_hangs_ends_it_with_one_line(program: Path, link: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        done = drive(program, link, "127.0.0.1", silent.getsockname()[1])
    assert (done.returncode, done.stderr) == (1, "error: no answer: \n")


def test_it_is_short() -> None:
    assert len(SOURCE.read_text().splitlines()) <= MAX_LINES

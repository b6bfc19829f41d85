"""Shared-memory segments: names, role locks, segments of killed processes and of other programs."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simulator.link.client import Link
from simulator.link.errors import LinkError, NameInUse, NoServer
from simulator.link.layout import MAGIC
from simulator.link.segment import Segment, attach, check_name, create, remove_stale
from tests.simulator.link.conftest import START_S

SIZE = 4096
SHM = Path("/dev/shm")

ENDING_SERVER = """
import signal, sys
from simulator.link import process
from simulator.link.server import LinkServer

original = LinkServer.close

def close(server):
    signal.raise_signal(signal.SIGTERM)
    original(server)

LinkServer.close = close
process.run(process.LinkConfig(name=sys.argv[1], track="oval"), print)
"""
"""A server that receives a signal after a client has ended it."""


def server_end(name: str) -> Segment:
    """A published segment that contains only the magic number."""
    segment = create(name, SIZE)
    segment.memory[: len(MAGIC)] = MAGIC
    segment.publish()
    return segment


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("driverview", "begins with a slash"),
        ("", "begins with a slash"),
        ("/", "begins with a slash"),
        ("/a/b", "one slash and then a plain name"),
        ("/..", "one slash and then a plain name"),
        ("/a\0b", "one slash and then a plain name"),
        ("/" + "x" * 250, "has 251 bytes"),
        ("/" + "\u00e4" * 125, "has 251 bytes"),
    ],
)
def test_bad_names_are_refused(name: str, said: str) -> None:
    with pytest.raises(LinkError, match=said):
        create(name, SIZE)
    with pytest.raises(LinkError, match=said):
        attach(name)


def test_the_longest_allowed_name_is_accepted() -> None:
    assert check_name("/" + "x" * 249)


def test_each_role_is_exclusive_and_detects_the_other(name: str) -> None:
    ours = server_end(name)
    assert not ours.peer_is_alive()
    with pytest.raises(NameInUse, match="is running"):
        server_end(name)
    client = attach(name)
    assert ours.peer_is_alive()
    assert client.peer_is_alive()
    with pytest.raises(NameInUse, match="has a client already"):
        attach(name)
    client.close()
    assert not ours.peer_is_alive()
    again = attach(name)
    ours.close()
    assert not again.peer_is_alive()
    assert not (SHM / name[1:]).exists()
    again.close()


def test_attaching_without_a_server_is_refused(name: str) -> None:
    with pytest.raises(NoServer, match=f"there is no server of the link {name}"):
        attach(name)


def killed_owner(name: str) -> None:
    """Create the segment in another process, and kill that process."""
    code = (
        "import time; from simulator.link.segment import create;"
        f"held = create({name!r}, {SIZE}); held.memory[:8] = {MAGIC!r}; held.publish();"
        "print('ready', flush=True); time.sleep(300)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()


def test_a_new_server_takes_over_from_a_killed_one(name: str) -> None:
    killed_owner(name)
    old = (SHM / name[1:]).stat().st_ino
    ours = server_end(name)
    assert (SHM / name[1:]).stat().st_ino != old
    assert not ours.bytes()[8:].any()
    ours.close()


def test_a_client_removes_the_segment_of_a_killed_server(name: str) -> None:
    killed_owner(name)
    with pytest.raises(NoServer, match="has died"):
        attach(name)
    assert not (SHM / name[1:]).exists()


def test_a_segment_is_invisible_before_it_is_published(name: str) -> None:
    ours = create(name, SIZE)
    with pytest.raises(NoServer):
        attach(name)
    ours.close()


def test_remove_stale_keeps_the_segment_of_a_running_server(name: str) -> None:
    remove_stale(name)
    killed_owner(name)
    remove_stale(name)
    assert not (SHM / name[1:]).exists()
    ours = server_end(name)
    with pytest.raises(NameInUse, match="is running"):
        remove_stale(name)
    assert (SHM / name[1:]).exists()
    ours.close()


def test_a_client_of_a_killed_server_does_not_remove_its_successors_segment(name: str) -> None:
    first = server_end(name)
    client = attach(name)
    os.close(first.descriptor)  # as the kernel does at its death
    first.descriptor = -1
    second = server_end(name)
    client.close()
    assert (SHM / name[1:]).exists()
    second.close()


def test_shared_memory_of_another_program_is_not_touched(name: str) -> None:
    path = SHM / name[1:]
    path.write_bytes(b"somebody else's")
    for action in (lambda: server_end(name), lambda: attach(name), lambda: remove_stale(name)):
        with pytest.raises(LinkError, match="is no link of this program"):
            action()
    assert path.read_bytes() == b"somebody else's"
    path.unlink()


def test_out_of_memory_raises_and_leaves_no_segment(name: str) -> None:
    code = (
        "import resource; from simulator.link.segment import create;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (65536, resource.RLIM_INFINITY));"
        f"create({name!r}, 1 << 20)"
    )
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "no room for 1048576 bytes of shared memory" in done.stderr
    assert not (SHM / name[1:]).exists()


def test_a_forked_child_does_not_hold_the_parents_lock(name: str) -> None:
    ours = server_end(name)
    client = attach(name)
    child = os.fork()
    if child == 0:
        time.sleep(120.0)
        os._exit(0)
    try:
        deadline = time.monotonic() + 60.0  # the child closes its copy first of all
        client.close()
        while ours.peer_is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not ours.peer_is_alive()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        ours.close()


def test_a_signal_while_the_server_ends_leaves_no_segment(name: str) -> None:
    process = subprocess.Popen([sys.executable, "-c", ENDING_SERVER, name])
    try:
        Link(name, wait_s=START_S).quit()
        assert process.wait(START_S) == 0
        assert not (SHM / name[1:]).exists()
    finally:
        process.kill()

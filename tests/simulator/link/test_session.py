"""Sessions of a link server: clients that connect, err, leave or die, and the server's end."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict

import pytest

from simulator.link.client import Link
from simulator.link.config import LinkConfig
from simulator.link.errors import (
    ClientLost,
    LinkError,
    LinkTimeout,
    NameInUse,
    Refused,
    ServerDied,
)
from simulator.link.layout import Mode, Refusal
from simulator.link.process import run
from simulator.link.server import Summary
from simulator.vehicle.state import Command
from tests.typed import error_line, typed

WAIT_S = 180.0
BOUND_S = 2.0
"""Longest wait (s) of a process after its peer has died."""

Start = Callable[..., "subprocess.Popen[str]"]

SIGNALLED_SERVER = """
import signal, sys
from contextlib import suppress
from simulator.link import process
from simulator.link.layout import Request
from simulator.link.simulation import Simulation

original = Simulation.answer

def answer(simulation, request):
    original(simulation, request)
    if request["request"] == Request.STEP:
        with suppress(BaseException):
            signal.raise_signal(int(sys.argv[2]))

process._warm_up = lambda *_: None  # it asks for steps, too
Simulation.answer = answer
process.run(process.LinkConfig(name=sys.argv[1], track="oval"), print)
"""
"""A server that receives a signal within each step, at a place where an exception is lost."""


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (Command(steer=math.nan), "steer = nan"),
        (Command(steer=1.01), r"steer = 1\.01"),
        (Command(throttle=-0.1), r"throttle = -0\.1"),
        (Command(brake=math.inf), "brake = inf"),
        (Command(gear=7), "gear = 7"),
    ],
)
def test_a_bad_command_is_refused_and_the_car_is_unchanged(
    oval: str, command: Command, said: str
) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        before = link.step(Command(throttle=0.5))
        with pytest.raises(Refused, match=said) as refusal:
            link.step(command)
        assert refusal.value.code == Refusal.BAD_COMMAND
        assert link.latest().state == before.state
        assert link.step(Command(throttle=0.5)).step == 2


def test_values_beyond_a_bound_by_the_rounding_of_float32_are_clipped(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        start = link.reset(seed=1, to_middle=link.info.edge + 1e-6, angle=0.1)
        assert start.state.to_middle == pytest.approx(link.info.edge, abs=1e-9)
        link.reset(seed=1)
        assert link.step(Command(steer=1.0000001, throttle=-1e-7)).step == 1


@pytest.mark.parametrize(
    ("start", "said"),
    [
        ({"s": math.inf}, "s = inf"),
        ({"to_middle": math.nan}, "to_middle = nan"),
        ({"to_middle": 50.0}, r"to_middle = 50\.0 m"),
        ({"speed": 1e9}, r"speed = 1000000000\.0"),
    ],
)
def test_a_bad_start_is_refused_and_the_episode_goes_on(
    oval: str, start: dict[str, float], said: str
) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        link.step(Command())
        with pytest.raises(Refused, match=said) as refusal:
            link.reset(seed=1, **start)
        assert refusal.value.code == Refusal.BAD_RESET
        assert link.step(Command()).step == 2


@pytest.mark.contacts  # in the step that ends it
def test_a_step_needs_an_episode_that_has_not_ended(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        with pytest.raises(LinkError, match="ask for a reset first"):
            link.step(Command())
        message = link.reset(seed=1, speed=25.0, angle=0.6)
        while message.ended is None:
            message = link.step(Command(steer=-1.0))
        assert (message.ended, message.reward) == ("off_track", -2.0)
        with pytest.raises(Refused, match=r"ended \(off_track\)") as refusal:
            link.step(Command())
        assert refusal.value.code == Refusal.EPISODE_ENDED
        assert link.reset(seed=1).ended is None


def test_an_unknown_request_is_answered_with_an_error(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        link._outbox.record["request"] = 99
        with pytest.raises(Refused, match="the request is 99") as refusal:
            link._request()
        assert refusal.value.code == Refusal.UNKNOWN_REQUEST
        assert link.step(Command()).step == 1


def test_a_command_with_a_bad_checksum_is_answered_with_an_error(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        words = link._outbox._buffer.arrays[1]
        words[5] ^= 1  # a client without the sequence lock can write such a message
        words.view("u4")[0] += 2
        deadline = time.monotonic() + WAIT_S
        while not (link._receive(0.05) and link._inbox.record["error"]):
            assert time.monotonic() < deadline
        assert link._inbox.record["error"] == Refusal.BAD_CHECKSUM
        assert link.step(Command()).step == 1


def test_a_reset_without_a_seed_uses_the_servers_seed(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        first = link.reset()
        second = link.reset()
        assert first.seed == 7 + first.episode  # the server was started with --seed 7
        assert second.seed == first.seed + 1
        assert link.reset(seed=11).seed == 11


def test_a_second_client_is_refused(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S), pytest.raises(NameInUse, match="has a client already"):
        Link(oval)
    with Link(oval) as after:
        assert after.reset(seed=1).step == 0


def test_an_episode_ends_when_its_client_leaves(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S) as link:
        link.reset(seed=1)
    with Link(oval) as link, pytest.raises(Refused, match="no episode yet"):
        link.step(Command())


def test_a_closed_link_raises(oval: str) -> None:
    link = Link(oval, wait_s=WAIT_S)
    link.close()
    link.close()
    with pytest.raises(LinkError, match="is closed"):
        link.step(Command())
    with pytest.raises(LinkError, match="is closed"):
        link.latest()


def test_a_second_server_with_the_same_name_is_refused(oval: str) -> None:
    with Link(oval, wait_s=WAIT_S):
        done = typed("simulator", "link", "--name", oval, "--track", "oval")
    assert done.returncode == 1
    assert error_line(done).startswith(f"error: a server of the link {oval} is running")


def test_quit_ends_the_server_and_prints_its_summary(name: str) -> None:
    with serving(LinkConfig(name=name, track="oval")) as served, Link(name, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        for _ in range(5):
            link.step(Command(throttle=1.0))
        with pytest.raises(Refused):
            link.step(Command(gear=9))
        link.quit()
        summary = served.result(WAIT_S)
    expected = {"clients": 1, "clients_lost": 0, "episodes": 1, "steps": 5, "refused": 1}
    assert asdict(summary) == expected
    assert served.said == [
        f"{name}: oval is ready for a client",
        f"client {os.getpid()} has connected",
        f"client {os.getpid()} has disconnected",
    ]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_notifies_the_client_and_prints_json(server: Start, name: str, number: int) -> None:
    process = server("--track", "oval", "--json")
    with Link(name, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        process.send_signal(number)
        out, said = process.communicate(timeout=WAIT_S)
        with pytest.raises(ServerDied, match="has ended"):
            link.step(Command())
    assert process.returncode == 0
    expected = {"clients": 1, "clients_lost": 0, "episodes": 1, "steps": 0, "refused": 0}
    assert json.loads(out) == expected
    assert f"{name}: stopped" in said


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_server_where_an_exception_would_be_lost(name: str, number: int) -> None:
    """numpy loses an exception that is raised while it compares a scalar with an IntEnum.

    The server runs in a process of its own, because SIGTERM would end the test process.
    """
    command = [sys.executable, "-c", SIGNALLED_SERVER, name, str(int(number))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        with Link(name, wait_s=WAIT_S) as link:
            link.reset(seed=1)
            link.step(Command())
            said, _ = process.communicate(timeout=WAIT_S)
            with pytest.raises(ServerDied, match="has ended"):
                link.step(Command())
    finally:
        process.kill()
    assert process.returncode == 0
    assert f"{name}: stopped" in said


@pytest.mark.alone
def test_a_suspended_server_times_out_after_two_seconds(server: Start, name: str) -> None:
    process = server("--track", "oval")
    with Link(name, wait_s=WAIT_S, timeout_s=0.5) as link:
        link.reset(seed=1)
        process.send_signal(signal.SIGSTOP)
        began = time.monotonic()
        with pytest.raises(LinkTimeout, match=r"is running, but has not answered within 0\.5 s"):
            link.step(Command())
        assert 0.4 < time.monotonic() - began < BOUND_S
        process.send_signal(signal.SIGCONT)
        assert link.reset(seed=1).step == 0


def test_once_ends_the_server_when_its_client_leaves(name: str) -> None:
    with serving(LinkConfig(name=name, track="oval", once=True)) as served:
        with Link(name, wait_s=WAIT_S) as link:
            link.reset(seed=1)
        assert served.result(WAIT_S).clients == 1


@pytest.mark.alone
def test_a_killed_client_ends_a_server_with_once(name: str) -> None:
    config = LinkConfig(name=name, track="oval", once=True)
    with serving(config) as served:
        link = Link(name, wait_s=WAIT_S)
        link.reset(seed=1)
        link._segment.close()  # the client leaves without a message
        with pytest.raises(ClientLost, match=r"has died at step 0 of episode 1"):
            served.result(BOUND_S)


@pytest.mark.alone
def test_a_client_that_sends_nothing_is_dropped(name: str) -> None:
    config = LinkConfig(name=name, track="oval", patience_s=0.3)
    with serving(config) as served, Link(name, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        with pytest.raises(ClientLost, match=r"is running, but has sent nothing for 0\.3 s"):
            served.result(BOUND_S)
        with pytest.raises(ServerDied, match="has ended"):
            link.step(Command())


@pytest.mark.alone
def test_real_time_steps_without_commands(name: str) -> None:
    config = LinkConfig(name=name, track="oval", realtime=True, frequency_hz=50)
    with serving(config), Link(name, wait_s=WAIT_S) as link:
        assert link.info.mode is Mode.REALTIME
        assert link.reset(seed=1).step == 0
        held = link.step(Command(throttle=1.0))
        began = time.monotonic()
        time.sleep(1.0)
        seconds = time.monotonic() - began
        later = link.latest()
        ticked = later.step + later.late_steps - held.step
        assert ticked == pytest.approx(50.0 * seconds, abs=15)
        assert later.state.vx > held.state.vx + 1.0  # the throttle is held
        with pytest.raises(Refused, match="steer = nan"):
            link.step(Command(steer=math.nan))
        assert link.step(Command(throttle=1.0)).step > later.step
        link.quit()


def test_in_real_time_the_car_stands_until_a_command_arrives(name: str) -> None:
    config = LinkConfig(name=name, track="oval", realtime=True, frequency_hz=100)
    with serving(config), Link(name, wait_s=WAIT_S) as link:
        link.reset(seed=1)
        deadline = time.monotonic() + WAIT_S
        while link.latest().step < 30:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert abs(link.latest().state.vx) < 0.5
        link.quit()


class Served:
    """A server in a thread of this process."""

    def __init__(self, config: LinkConfig) -> None:
        self.said: list[str] = []
        self._pool = ThreadPoolExecutor(1)
        self._future = self._pool.submit(run, config, self.said.append)

    def result(self, seconds: float) -> Summary:
        return self._future.result(seconds)


@contextmanager
def serving(config: LinkConfig) -> Iterator[Served]:
    served = Served(config)
    try:
        yield served
    finally:
        served._pool.shutdown(wait=True)

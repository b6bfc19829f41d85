"""Kills one side of the link (SIGKILL), measures the time until the other side notices the kill,
and looks for shared-memory segments that remain."""

import random
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.shared_memory.processes import START_S, start, start_server
from simulator.link.client import Link
from simulator.link.errors import ServerDied
from simulator.link.segment import SHM
from simulator.vehicle.state import Command

if TYPE_CHECKING:
    import subprocess

BOUND_S = 2.0
"""Longest time in s after which the other side must notice the kill."""


class Killer:
    """Kills one side of a running link at a random moment, and measures the time until the other
    side notices the kill."""

    def __init__(self, hammer: str, seed: int) -> None:
        self._hammer = hammer
        self._random = random.Random(seed)
        self._name, self._server = start_server()
        self._next = start_server()  # the next server starts while the first server is in use

    def server_under_python(self) -> float:
        """Kill the server of a Python client; return the seconds until ServerDied is raised."""
        with Link(self._name, wait_s=START_S) as link:
            message = link.reset(seed=1)
            killed: list[float] = []
            timer = threading.Timer(self._moment(), self._kill_server, [killed])
            timer.start()
            try:
                while True:
                    message = link.step(Command(throttle=0.2))
                    if message.ended:
                        message = link.reset(seed=1)
            except ServerDied:
                return self._done(time.monotonic() - killed[0])

    def server_under_c(self) -> float:
        """Kill the server of a C client; return the seconds until the client has exited."""
        client = self._drive()
        time.sleep(self._moment())
        killed: list[float] = []
        self._kill_server(killed)
        _, said = client.communicate(timeout=10.0 * BOUND_S)
        seconds = time.monotonic() - killed[0]
        if "has died" not in said or client.returncode != 1:
            raise SystemExit(f"the client does not say that its server died: {said!r}")
        return self._done(seconds)

    def client(self) -> float:
        """Kill a C client; return the seconds until a new client gets its first answer."""
        victim = self._drive()
        time.sleep(self._moment())
        victim.kill()
        killed = time.monotonic()
        victim.communicate()
        with Link(self._name, wait_s=BOUND_S) as link:
            link.reset(seed=1)
            return time.monotonic() - killed

    def close(self) -> list[str]:
        """Stop both servers; return the names of the shared-memory segments that remain."""
        for name, server in ((self._name, self._server), self._next):
            Link(name, wait_s=START_S).quit()
            server.communicate(timeout=START_S)
        return [path.name for path in SHM.glob("drvlink-bench-*")]

    def _moment(self) -> float:
        return self._random.uniform(0.0, 0.05)

    def _drive(self) -> "subprocess.Popen[str]":
        client = start(self._hammer, "drive", self._name)
        assert client.stdout is not None
        if client.stdout.readline() != "driving\n":
            self._server.kill()
            told = client.communicate()[1] + self._server.communicate()[1]
            raise SystemExit(f"the client does not drive: {told}")
        return client

    def _kill_server(self, killed: list[float]) -> None:
        killed.append(time.monotonic())
        self._server.send_signal(signal.SIGKILL)

    def _done(self, seconds: float) -> float:
        self._server.communicate()
        if (SHM / self._name[1:]).exists():
            raise SystemExit(f"the segment {self._name} is left behind")
        (self._name, self._server), self._next = self._next, start_server()
        return seconds


def kill(hammer: str, kills: int) -> dict[str, Any]:
    killer = Killer(hammer, seed=1)
    sides = {"client": killer.client, "server": killer.server_under_c}
    sides["server_python"] = killer.server_under_python
    # Servers and clients are killed equally often.
    order = [("client", "server", "client", "server_python")[i % 4] for i in range(kills)]
    random.Random(2).shuffle(order)
    times: dict[str, list[float]] = {side: [] for side in sides}
    for number, side in enumerate(order):
        times[side].append(sides[side]())
        print(f"kill {number + 1}/{kills}: {side} {times[side][-1]:.3f} s", file=sys.stderr)
    leaked = killer.close()
    return {
        "kills": kills,
        "leaked_segments": leaked,
        "longest_s": {side: round(max(t), 3) for side, t in times.items() if t},
        "median_s": {side: round(float(np.median(t)), 4) for side, t in times.items() if t},
    }

"""The shared-memory link: torn messages, hangs after a kill, leaked segments, and its speed.

Run: `python benchmarks/link.py [--messages 1000000] [--patience 600] [--kills 200] [--steps 5000]
[--json FILE]`. `--patience` is the time limit in s for the messages of each direction. `--flood`
and `--echo` are for internal use. Limits: of 10^6 messages in each direction, read while the writer
writes at full speed, none is torn; in 200 trials in which one side is killed (SIGKILL) at a random
moment, the other side notices the kill within 2 s and no segment remains. As a control, a reader
without the sequence lock must see torn messages. The benchmark needs gcc.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, not_measured, run_command
from benchmarks.shared_memory.integrity import client_to_server, server_to_client, write_states
from benchmarks.shared_memory.kills import BOUND_S, kill
from benchmarks.shared_memory.processes import (
    INFO,
    START_S,
    TRACK,
    compile_hammer,
    fresh_name,
    start,
    start_server,
)
from simulator.link.client import Link
from simulator.link.server import LinkServer
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World


class Echo:
    """A simulation for the link that only counts steps, so that the time of the link alone is
    measured."""

    episodes, steps, refused, running, position_text = 0, 0, 0, False, ""

    def __init__(self, record: Any, image: Any) -> None:
        self._record = record

    def answer(self, request: Any) -> None:
        self._record["step"] += 1

    def end_episode(self) -> None:
        pass


def serve_echo(name: str) -> None:
    make: Any = Echo
    with LinkServer(name, INFO, make) as server:
        server.serve()


def figures(microseconds: list[float]) -> dict[str, float]:
    return {
        "median_us": round(float(np.median(microseconds)), 1),
        "p99_us": round(float(np.percentile(microseconds, 99)), 1),
        "per_second": round(1e6 * len(microseconds) / sum(microseconds)),
    }


def steps_in_python(name: str, steps: int) -> list[float]:
    taken = []
    with Link(name, wait_s=START_S) as link:
        message = link.reset(seed=1)
        for _ in range(steps):
            began = time.perf_counter()
            message = link.step(Command(throttle=0.2))
            taken.append(1e6 * (time.perf_counter() - began))
            if message.ended:
                message = link.reset(seed=1)
    return taken


def steps_in_c(hammer: str, name: str, steps: int) -> list[float]:
    command = [hammer, "time", name, str(steps)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]


def steps_here(world: World, steps: int) -> list[float]:
    from simulator.env.reward import ending
    from simulator.sensors.standard import read_track_range

    world.reset(seed=1)
    taken = []
    for _ in range(steps):
        began = time.perf_counter()
        state = world.step(Command(throttle=0.2))
        read_track_range(world)
        world.features()
        taken.append(1e6 * (time.perf_counter() - began))
        if ending(state):
            world.reset(seed=1)
    return taken


def speed(hammer: str, steps: int) -> dict[str, Any]:
    """Return the times in us of a step in this process and over the link, with clients in Python
    and C.

    The variants take turns, so that other load on the machine affects all of them alike.
    """
    echo = fresh_name()
    name, server = start_server()
    echoing = start(sys.executable, __file__, "--echo", echo)
    taken: dict[str, list[float]] = {}
    with World(Road(find_track(TRACK))) as world:
        steps_here(world, 100)
        for _ in range(5):
            part = steps // 5
            for what, more in (
                ("world_in_process", steps_here(world, part)),
                ("server_python_client", steps_in_python(name, part)),
                ("server_c_client", steps_in_c(hammer, name, part)),
                ("link_alone_python_client", steps_in_python(echo, part)),
                ("link_alone_c_client", steps_in_c(hammer, echo, part)),
            ):
                taken.setdefault(what, []).extend(more)
    for link_name, process in ((name, server), (echo, echoing)):
        Link(link_name).quit()
        process.communicate(timeout=START_S)
    return {what: figures(times) for what, times in taken.items()}


def missed(result: dict[str, Any], messages: int) -> list[str]:
    """Return a message for each limit that `result` misses, and print the messages on stderr.
    `messages` is the number of messages in each direction."""
    found = []
    for way in ("server_to_client", "client_to_server"):
        if way in result:
            count = result[way]
            if count["torn"] or count["damaged"]:
                found.append(f"{way}: {count['torn']} torn, {count['damaged']} damaged")
            if count["messages"] < messages:
                found.append(f"{way}: only {count['messages']} messages in time")
    if "control_without_lock" in result and not result["control_without_lock"]["torn"]:
        found.append(
            "the control without the lock saw no torn message either, so the test proves nothing"
        )
    if "killed" in result:
        if max(result["killed"]["longest_s"].values()) > BOUND_S:
            found.append(f"a survivor took over {BOUND_S} s")
        if result["killed"]["leaked_segments"]:
            found.append("a segment is left behind")
    for line in found:
        print(f"missed: {line}", file=sys.stderr)
    return found


def main(
    messages: int = 1_000_000,
    patience: float = 600.0,
    kills: int = 200,
    steps: int = 5000,
    json: Path | None = None,
    flood: str = "",
    echo: str = "",
) -> None:
    # SIGTERM raises SystemExit, so that segments and processes are cleaned up as with Ctrl-C.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    if flood:
        write_states(flood)
    if echo:
        serve_echo(echo)
        return
    if shutil.which("gcc") is None:
        not_measured("this benchmark needs gcc: apt-get install gcc libc6-dev")
    with tempfile.TemporaryDirectory() as folder:
        hammer = compile_hammer(Path(folder))
        result: dict[str, Any] = {"cores": os.cpu_count()}
        if messages:
            wanted = messages, patience
            result["server_to_client"] = server_to_client(hammer, "read", *wanted)
            result["client_to_server"] = client_to_server(hammer, *wanted)
            result["control_without_lock"] = server_to_client(hammer, "racy", *wanted)
        if kills:
            result["killed"] = kill(hammer, kills)
        if steps:
            result["speed"] = speed(hammer, steps)
    result["limits_kept"] = not missed(result, messages)
    conclude(result, json, result["limits_kept"])


if __name__ == "__main__":
    run_command(main)

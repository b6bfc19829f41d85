"""The shared-memory link: no torn message, no hang after a kill, no leaked segment; how fast it is.

Run: `python benchmarks/link.py [--messages 1000000] [--kills 200] [--steps 5000] [--json FILE]`.
Limits: of 10^6 messages in each direction, verified against a writer at full speed, none torn; with
either side killed by SIGKILL at a random moment 200 times, the survivor knows within 2 s and no
segment is left. As a control, a reader that ignores the sequence lock sees torn ones. Needs gcc.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from runtime.jit import compiled
from simulator.link.channel import Receiver, Sender, state_image_bytes
from simulator.link.client import Link
from simulator.link.errors import LinkError, ServerDied
from simulator.link.handshake import ServerInfo, write_header
from simulator.link.layout import COMMAND, STATE, Mode, segment_size
from simulator.link.segment import SHM, Segment, create
from simulator.link.server import LinkServer
from simulator.link.sync.seqlock import DAMAGED, READ, publish, spin_until_new, try_read
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World

BOUND_S = 2.0
START_S = 180.0
"""A server compiles first, where its cache is cold."""
PICTURE = 32, 24
TRACK = "oval"
INFO = ServerInfo("none", 1, 4.0, 1.0, 1.0, 1.0, 1.0, 0, 20, Mode.LOCK_STEP, 0, 0, 0, (0.0,) * 19)


def fresh_name() -> str:
    return f"/drvlink-bench-{uuid.uuid4().hex[:12]}"


def compile_hammer(folder: Path) -> str:
    program = str(folder / "link_hammer")
    source = Path(__file__).with_name("link_hammer.c")
    include = f"-I{files('simulator.link').joinpath('c')}"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", "-D_GNU_SOURCE", include]
    subprocess.run(["gcc", *strict, "-o", program, str(source), "-lm"], check=True)
    return program


def start(*command: str, out: Any = subprocess.PIPE) -> "subprocess.Popen[str]":
    return subprocess.Popen(list(command), stdout=out, stderr=subprocess.PIPE, text=True)


# ---- torn messages ---------------------------------------------------------------------------


@compiled
def flood(
    sequence: Any, shared: Any, local: Any, shared_image: Any, local_image: Any, first: int
) -> int:
    """Publish messages whose words are all their own number; a pause lets a reader come between."""
    for number in range(first, first + 5000):
        local[1:] = number
        local_image[:] = number
        publish(sequence, shared, local, shared_image, local_image)
        # Up to 4 us, of changing length so that the two sides do not keep in step.
        spin_until_new(sequence, int(sequence[0]), number % 7 * 1000)
    return first + 5000


@compiled
def verify(
    sequence: Any, shared: Any, local: Any, shared_image: Any, local_image: Any, goal: int
) -> tuple[int, int, int]:
    """Take up to `goal` messages in 10^6 looks: (whole, torn, damaged)."""
    whole, torn, damaged, seen = 0, 0, 0, 0
    for _ in range(1_000_000):
        if whole + torn >= goal:
            break
        outcome, seen = try_read(sequence, shared, local, shared_image, local_image, seen)
        if outcome == DAMAGED:
            damaged += 1
        if outcome == READ:
            if np.all(local[1:-1] == local[1]):
                whole += 1
            else:
                torn += 1
    return whole, torn, damaged


def segment_for_flood(name: str, picture: tuple[int, int]) -> Segment:
    """The server's end of a link without a server."""
    info = INFO.__class__(
        **{**INFO.__dict__, "image_width": picture[0], "image_height": picture[1]}
    )
    segment = create(name, segment_size(*picture))
    write_header(segment, info)
    segment.publish()
    return segment


def write_states(name: str) -> None:
    """In a process of its own: state messages as fast as it can, until it is killed."""
    segment = segment_for_flood(name, PICTURE)
    arrays = Sender(segment, STATE, state_image_bytes(segment))._buffer.arrays
    number = 1
    while True:
        number = flood(*arrays, number)


def server_to_client(hammer: str, task: str, messages: int, patience_s: float) -> dict[str, float]:
    """numba writes states with pictures, C reads them."""
    name = fresh_name()
    writer = start(sys.executable, __file__, "--write-states", name)
    try:
        told = subprocess.run(
            [hammer, task, name, str(messages), str(patience_s)],
            check=True,
            capture_output=True,
            text=True,
        )
    finally:
        writer.kill()
        writer.communicate()
        Path(SHM / name[1:]).unlink(missing_ok=True)
    result: dict[str, float] = json.loads(told.stdout)
    return result


def client_to_server(hammer: str, messages: int, patience_s: float) -> dict[str, float]:
    """C writes commands, numba reads them."""
    name = fresh_name()
    segment = segment_for_flood(name, (0, 0))
    writer = start(hammer, "write", name)
    arrays = Receiver(segment, COMMAND)._buffer.arrays
    verify(*arrays, 0)  # compiled before the clock runs
    whole, torn, damaged = 0, 0, 0
    began = time.monotonic()
    try:
        while whole + torn < messages and time.monotonic() - began < patience_s:
            more = verify(*arrays, messages - whole - torn)
            whole, torn, damaged = whole + more[0], torn + more[1], damaged + more[2]
    finally:
        seconds = time.monotonic() - began
        segment.close()
        writer.communicate(timeout=START_S)
    return {
        "messages": whole + torn,
        "torn": torn,
        "damaged": damaged,
        "seconds": round(seconds, 3),
    }


# ---- kills -----------------------------------------------------------------------------------


def start_server() -> tuple[str, "subprocess.Popen[str]"]:
    name = fresh_name()
    command = [sys.executable, "-m", "simulator", "link", "--name", name, "--track", TRACK]
    return name, start(*command, out=subprocess.DEVNULL)


class Killer:
    """Kills one side of a running link at a random moment, and times how long the other takes."""

    def __init__(self, hammer: str, seed: int) -> None:
        self._hammer = hammer
        self._random = random.Random(seed)
        self._name, self._server = start_server()
        self._next = start_server()  # the next is made while this one is in use

    def server_under_python(self) -> float:
        """Seconds from the server's death to ServerDied."""
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
        """Seconds from the server's death to the C client's end."""
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
        """Seconds from a client's death to the next one's first answer."""
        victim = self._drive()
        time.sleep(self._moment())
        victim.kill()
        killed = time.monotonic()
        victim.communicate()
        with Link(self._name, wait_s=BOUND_S) as link:
            link.reset(seed=1)
            return time.monotonic() - killed

    def close(self) -> list[str]:
        """Stop what runs; names of segments left behind."""
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
    # As many servers as clients.
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


# ---- speed -----------------------------------------------------------------------------------


class Echo:
    """A simulation that does nothing: what is left is the link."""

    episodes, steps, refused, running, place = 0, 0, 0, False, ""

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
    """Interleaved, so that other work on the machine meets all of them alike."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--patience", type=float, default=600.0, help="seconds a count")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write-states", help=argparse.SUPPRESS)
    parser.add_argument("--echo", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    # Stopped from outside, it cleans up behind itself as with Ctrl-C.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    if arguments.write_states:
        write_states(arguments.write_states)
    if arguments.echo:
        serve_echo(arguments.echo)
        return
    if shutil.which("gcc") is None:
        raise SystemExit("this benchmark needs gcc: apt-get install gcc libc6-dev")
    with tempfile.TemporaryDirectory() as folder:
        hammer = compile_hammer(Path(folder))
        result: dict[str, Any] = {"cores": os.cpu_count()}
        if arguments.messages:
            wanted = arguments.messages, arguments.patience
            result["server_to_client"] = server_to_client(hammer, "read", *wanted)
            result["client_to_server"] = client_to_server(hammer, *wanted)
            result["control_without_lock"] = server_to_client(hammer, "racy", *wanted)
        if arguments.kills:
            result["killed"] = kill(hammer, arguments.kills)
        if arguments.steps:
            result["speed"] = speed(hammer, arguments.steps)
    result["limits_kept"] = not missed(result, arguments.messages)
    print(json.dumps(result, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2))
    sys.exit(not result["limits_kept"])


def missed(result: dict[str, Any], messages: int) -> list[str]:
    """Which limits were, in words; also on stderr."""
    found = []
    for way in ("server_to_client", "client_to_server"):
        if way in result:
            count = result[way]
            if count["torn"] or count["damaged"]:
                found.append(f"{way}: {count['torn']} torn, {count['damaged']} damaged")
            if count["messages"] < messages:
                found.append(f"{way}: only {count['messages']} messages in time")
    if "control_without_lock" in result and not result["control_without_lock"]["torn"]:
        found.append("the control saw no torn message either: the test shows nothing")
    if "killed" in result:
        if max(result["killed"]["longest_s"].values()) > BOUND_S:
            found.append(f"a survivor took over {BOUND_S} s")
        if result["killed"]["leaked_segments"]:
            found.append("a segment is left behind")
    for line in found:
        print(f"missed: {line}", file=sys.stderr)
    return found


if __name__ == "__main__":
    try:
        main()
    except LinkError as error:
        raise SystemExit(f"error: {error}") from error

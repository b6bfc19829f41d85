"""Sends a million mutated byte streams to the service's HTTP and WebSocket protocols, in process.

A stream begins with a request, a handshake or both. They come from the attacks of the tests or from
a grammar (`service_load/stream_grammar.py`). WebSocket frames follow if the handshake was accepted.
The stream arrives in parts, on a transport that behaves like uvloop's. It is a fault if the service
raises an exception, hangs, answers 500, logs an error or leaves objects behind. The seed, part and
number in the message of a fault reproduce its stream.

    python benchmarks/service_stream_fuzz.py [--count 1000000] [--seed 0] [--workers N]
"""

import asyncio
import logging
import os
import random
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from uvicorn.server import ServerState

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load import stream_grammar
from serve.app import Service
from serve.config import Limits
from serve.server.fast_path import DirectProtocol
from serve.server.guard import ConnectionGuard
from serve.server.websocket import GuardedWebSocket
from tests.serve.attacks.attacks import mutate, whole_streams
from tests.serve.attacks.conftest import Target, resident_mb
from tests.serve.conftest import FakeEngine, outputs

MAX_GROWTH = 0.02
HANG_S = 1.0  # processor time for one stream that counts as a hang
TURNS = 8  # the event loop makes fewer iterations than this after the begin and after the frames


class Transport:
    """A transport without a socket. It stores the bytes that are written, and raises the same
    errors as a transport of uvloop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self.protocol: Any = None
        self.written = b""
        self.closing = self.ended = self.lost = self.paused = False

    def get_extra_info(self, _name: str) -> None:
        return None

    def set_protocol(self, protocol: Any) -> None:
        self.protocol = protocol

    def write(self, data: bytes) -> None:
        if self.lost or self.ended:
            raise RuntimeError("write after the end")
        self.written += data

    def write_eof(self) -> None:
        if self.lost:
            raise RuntimeError("write after the end")
        self.ended = True

    def close(self) -> None:
        if not self.closing:
            self.closing = True
            self.loop.call_soon(self.lose)

    abort = close

    def lose(self) -> None:
        """Call the protocol's `connection_lost`, once."""
        if not self.lost:
            self.closing = self.lost = True
            self.protocol.connection_lost(None)

    def is_closing(self) -> bool:
        return self.closing

    def get_write_buffer_size(self) -> int:
        return 0

    def pause_reading(self) -> None:
        self.paused = True

    def resume_reading(self) -> None:
        self.paused = False


class Errors(logging.Handler):
    """Stores the text of each log record of level WARNING or above."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.found.append(f"{record.name}: {record.getMessage()[:200]}")


def opening(rng: random.Random, known: list[bytes]) -> bytes:
    """Return the begin of a stream. It comes from the grammar, is mutated from a stream of the
    grammar, or is mutated from one of the streams `known`."""
    made = [stream_grammar.message(rng) for _ in range(rng.choice([1, 1, 2]))]
    if rng.random() < 0.3:
        return b"".join(made)
    return mutate(rng, made if rng.random() < 0.6 else known)


def frames(rng: random.Random) -> bytes:
    """Return random WebSocket frames, mutated in half of the calls."""
    made = stream_grammar.frames(rng)
    return made if rng.random() < 0.5 else mutate(rng, [made])


async def feed(transport: Transport, rng: random.Random, sent: bytes) -> None:
    """Give the bytes `sent` to the transport's protocol in parts of random size."""
    while sent and not transport.closing:
        for _ in range(TURNS * TURNS):  # largest wait of the client while reading is paused
            if not transport.paused:
                break
            await asyncio.sleep(0)
        else:
            return
        size = rng.choice([1, 7, 100, len(sent)])
        transport.protocol.data_received(sent[:size])
        sent = sent[size:]
        if rng.randrange(3) == 0:
            await asyncio.sleep(0)


async def stream(make: Any, rng: random.Random, whole: list[bytes]) -> bytes:
    """Send one random stream over a new connection; return the bytes of the answers.

    `make` makes the protocol; `whole` are the complete streams of the tests' attacks.
    """
    transport = Transport(asyncio.get_running_loop())
    transport.protocol = make()
    transport.protocol.connection_made(transport)
    await feed(transport, rng, opening(rng, whole))
    for _ in range(rng.randrange(TURNS)):
        await asyncio.sleep(0)
    if isinstance(transport.protocol, GuardedWebSocket) and not transport.closing:
        await feed(transport, rng, frames(rng))
        for _ in range(rng.randrange(TURNS)):
            await asyncio.sleep(0)
    if not transport.lost:
        transport.lose()
    return transport.written


async def run_part(seed: int, part: int, count: int) -> tuple[float, list[str]]:
    """Send `count` streams, which are determined by `seed` and `part`. Return the growth of the
    memory as a share, and a message for each fault."""
    engine = FakeEngine(lambda _image: outputs())
    app = Service(engine, lambda _engine: None, Limits())
    config = uvicorn.Config(app, http="httptools", ws=GuardedWebSocket, log_config=None)
    config.ws_per_message_deflate = False
    config.load()
    app.frame_queue.start()
    errors, faults, state = Errors(), [], ServerState()
    logging.getLogger().addHandler(errors)
    guard = ConnectionGuard(Limits(), bodies=app.bodies)
    app.bodies.end_slow_bodies = guard.end_slow_bodies
    loop = asyncio.get_running_loop()
    make = partial(
        DirectProtocol,
        service=app,
        guard=guard,
        config=config,
        server_state=state,
        app_state={},
        _loop=loop,
    )
    whole, early_mb = whole_streams(Target(80)), 0.0
    for number in range(count):
        rng = random.Random(f"{seed} {part} {number}")
        try:
            begin = time.thread_time()
            if b"HTTP/1.1 500" in await stream(make, rng, whole):
                faults.append(f"part {part}, number {number}: 500")
            if time.thread_time() - begin > HANG_S:
                faults.append(f"part {part}, number {number}: {HANG_S:g} s")
        except Exception as error:  # noqa: BLE001  # the benchmark looks for any exception
            faults.append(f"part {part}, number {number}: {error!r}")
        faults += [f"part {part}, number {number}: {said}" for said in errors.found]
        errors.found.clear()
        engine.images.clear()  # so that the images in the fake engine do not count as memory growth
        if number == count // 5:
            early_mb = resident_mb()
    while state.tasks:
        await asyncio.sleep(0.01)
    groups = (guard.receiving, guard.working, guard.idle, guard.served, guard.streams)
    if state.connections or any((*groups, guard.refused, guard.closing)):
        faults.append(f"part {part}: connections were left behind")
    if app.bodies.held:
        faults.append(f"part {part}: {app.bodies.held} bytes of bodies were left behind")
    app.frame_queue.close()
    logging.getLogger().removeHandler(errors)
    return resident_mb() / early_mb - 1.0, faults


def run_in_loop(seed: int, part: int, count: int) -> tuple[float, list[str]]:
    """Call `run_part` in a new event loop and return its result."""
    logging.getLogger("serve").setLevel(logging.ERROR)
    return asyncio.run(run_part(seed, part, count))


def main(count: int = 1_000_000, seed: int = 0, workers: int = os.cpu_count() or 1) -> None:
    share, parts = count // workers, range(workers)
    begin = time.monotonic()
    with ProcessPoolExecutor(workers) as pool:  # a crash of a worker raises BrokenProcessPool
        found = list(pool.map(run_in_loop, [seed] * workers, parts, [share] * workers))
    growth, faults = max(part[0] for part in found), [f for part in found for f in part[1]]
    seconds = time.monotonic() - begin
    figures = {
        "streams": share * workers,
        "streams_per_second": round(share * workers / seconds),
        "faults": faults[:20],
        "memory_growth": round(growth, 4),
        "claim_growth_below": MAX_GROWTH,
    }
    conclude(figures, None, not faults and growth < MAX_GROWTH)


if __name__ == "__main__":
    run_command(main)

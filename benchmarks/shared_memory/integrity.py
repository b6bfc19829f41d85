"""Counts torn messages of the link: one side writes at full speed, the other side verifies."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.shared_memory.processes import INFO, LINK, START_S, fresh_name, start
from runtime.jit import compiled
from simulator.link.channel import Receiver, Sender, state_image_bytes
from simulator.link.handshake import write_header
from simulator.link.layout import COMMAND, STATE, segment_size
from simulator.link.segment import SHM, Segment, create
from simulator.link.sync.seqlock import DAMAGED, READ, publish, spin_until_new, try_read

PICTURE = 32, 24


@compiled
def flood(
    sequence: Any, shared: Any, local: Any, shared_image: Any, local_image: Any, first: int
) -> int:
    """Publish 5,000 messages with the numbers from `first` on, and return the next number. All
    words of a message contain its number.

    A pause after each message gives the reader a chance to read the message.
    """
    for number in range(first, first + 5000):
        local[1:] = number
        local_image[:] = number
        publish(sequence, shared, local, shared_image, local_image)
        # Pauses of different lengths up to 4 us, so that the two sides do not synchronise.
        spin_until_new(sequence, int(sequence[0]), number % 7 * 1000)
    return first + 5000


@compiled
def verify(
    sequence: Any, shared: Any, local: Any, shared_image: Any, local_image: Any, goal: int
) -> tuple[int, int, int]:
    """Try at most 10^6 times to read a message, until `goal` messages are read. Return the numbers
    of whole, torn and damaged messages."""
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
    """Create and publish the segment of a link for a `picture` of (width, height) px."""
    info = INFO.__class__(
        **{**INFO.__dict__, "image_width": picture[0], "image_height": picture[1]}
    )
    segment = create(name, segment_size(*picture))
    write_header(segment, info)
    segment.publish()
    return segment


def write_states(name: str) -> None:
    """Write state messages as fast as possible until this process is killed."""
    segment = segment_for_flood(name, PICTURE)
    arrays = Sender(segment, STATE, state_image_bytes(segment))._buffer.arrays
    number = 1
    while True:
        number = flood(*arrays, number)


def server_to_client(hammer: str, task: str, messages: int, patience_s: float) -> dict[str, float]:
    """Count the torn messages when numba code writes states with pictures and the C program
    `hammer` reads them, until `messages` are read, for at most `patience_s` s.

    `task` of the C program: "read", or "racy" to read without the lock.
    """
    name = fresh_name()
    writer = start(sys.executable, str(LINK), "--flood", name)
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
    """Count the torn messages when the C program `hammer` writes commands and numba code reads
    them, until `messages` are read, for at most `patience_s` s."""
    name = fresh_name()
    segment = segment_for_flood(name, (0, 0))
    writer = start(hammer, "write", name)
    arrays = Receiver(segment, COMMAND)._buffer.arrays
    verify(*arrays, 0)  # compiles the function before the time is measured
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

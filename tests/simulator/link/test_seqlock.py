"""The sequence lock: single operations, then concurrent writers and killed processes."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulator.link import channel
from simulator.link.client import Link
from simulator.link.sync.seqlock import (
    DAMAGED,
    NOTHING,
    READ,
    TORN,
    checksum,
    publish,
    try_read,
)
from simulator.vehicle.state import Command
from tests.simulator.link.conftest import START_S

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "link.py"
WORDS, PICTURE = 12, 5
BOUND_S = 2.0


class Block:
    """One message direction in ordinary memory, with the writer's and the reader's local copies."""

    def __init__(self) -> None:
        self.shared, self.picture = np.zeros(WORDS, np.uint64), np.zeros(PICTURE, np.uint64)
        self.sequence = self.shared.view(np.uint32)[:1]
        self.message, self.image = np.zeros(WORDS, np.uint64), np.zeros(PICTURE, np.uint64)
        self.copy, self.image_copy = np.zeros(WORDS, np.uint64), np.zeros(PICTURE, np.uint64)

    def write(self, value: int) -> None:
        self.message[1:-1] = value
        self.image[:] = value
        publish(self.sequence, self.shared, self.message, self.picture, self.image)

    def read(self, seen: int = 0) -> tuple[int, int]:
        return try_read(self.sequence, self.shared, self.copy, self.picture, self.image_copy, seen)


def test_a_message_is_read_complete_with_its_image() -> None:
    block = Block()
    block.write(7)
    assert block.read() == (READ, 2)
    assert block.copy[1:-1].tolist() == [7] * (WORDS - 2)
    assert block.image_copy.tolist() == [7] * PICTURE
    assert block.read(seen=2) == (NOTHING, 2)
    block.write(8)
    assert block.read(seen=2) == (READ, 4)


def test_nothing_is_read_during_a_write() -> None:
    block = Block()
    block.write(7)
    block.sequence[0] += 1
    assert block.read() == (NOTHING, 0)


def test_a_new_writer_continues_after_a_killed_writer() -> None:
    block = Block()
    block.write(7)
    block.sequence[0] += 1
    block.shared[3] = 99
    block.write(8)
    assert block.read() == (READ, 4)
    assert set(block.copy[1:-1].tolist()) == {8}


def test_checksum_detects_any_changed_word() -> None:
    for word in range(1, WORDS):
        block = Block()
        block.write(7)
        block.shared[word] ^= np.uint64(1 << 40)
        assert block.read()[0] == DAMAGED


def test_the_latest_message_is_read_again_after_a_torn_copy(
    oval: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = [TORN, TORN]

    def torn_twice(sequence: Any, shared: Any, local: Any, *rest: Any) -> Any:
        if not outcomes:
            return try_read(sequence, shared, local, rest[0], rest[1], 0)
        local[1:] = 2**63
        return outcomes.pop(), int(rest[-1])

    with Link(oval, wait_s=START_S) as link:
        link.reset(seed=1)
        before = link.step(Command(throttle=0.5))
        monkeypatch.setattr(channel, "try_read", torn_twice)
        latest = link.latest()
        assert not outcomes
        monkeypatch.setattr(channel, "try_read", try_read)
        assert latest.state == before.state


def test_the_sequence_wraps_around() -> None:
    block = Block()
    block.sequence[0] = 2**32 - 2
    block.write(7)
    assert block.sequence[0] == 0
    assert block.read(seen=2**32 - 2) == (READ, 0)


def test_the_checksum_is_fnv_1a() -> None:
    """Equals FNV-1a in Python integers, with the published offset and prime."""
    message = np.arange(WORDS, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    value = 0xCBF29CE484222325
    for word in message[1:-1].tolist():
        value = (value ^ word) * 0x100000001B3 % 2**64
    assert int(checksum(message)) == value


@pytest.mark.slow
@pytest.mark.alone
def test_no_torn_messages_hangs_or_leaks_under_load() -> None:
    """A short run of the benchmark: up to 20,000 messages each way, and each kind of kill."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    counts = ("--messages", "20000", "--patience", "5", "--kills", "4", "--steps", "0")
    command = [sys.executable, str(BENCHMARK), *counts]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.stdout, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    for way in ("server_to_client", "client_to_server"):
        assert (result[way]["torn"], result[way]["damaged"]) == (0, 0)
        assert result[way]["messages"] > 100
    killed = result["killed"]
    assert (killed["kills"], killed["leaked_segments"]) == (4, [])
    assert max(killed["longest_s"].values()) < BOUND_S

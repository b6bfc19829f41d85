"""Free memory of the heap is returned to the system."""

import pytest

from serve.server import heap
from serve.server.heap import GROWTH_BYTES, HeapTrimmer, trim_heap


def test_the_heap_is_trimmed_while_memory_is_larger_than_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    resident = [100 * GROWTH_BYTES]
    trims: list[int] = []
    monkeypatch.setattr(heap, "_resident_bytes", lambda: resident[-1])
    monkeypatch.setattr(heap, "trim_heap", lambda: trims.append(resident[-1]))
    trim_if_grown = HeapTrimmer()
    for size in (100, 99, 99.9, 100, 102, 99, 98, 98.5):
        resident.append(int(size * GROWTH_BYTES))
        trim_if_grown()
    assert trims == [100 * GROWTH_BYTES, 102 * GROWTH_BYTES]


def test_freed_blocks_of_the_heap_are_given_back() -> None:
    trim_heap()
    before = heap._resident_bytes()
    assert before > 1 << 20
    kept = []
    for _ in range(2000):  # small enough for the heap; the kept blocks prevent merging
        block = bytearray(100 << 10)
        kept.append(bytearray(200))
        kept.append(block)
    grown = heap._resident_bytes()
    assert grown - before > 150 << 20
    del block, kept[1::2]
    trim_heap()
    assert heap._resident_bytes() - before < 60 << 20

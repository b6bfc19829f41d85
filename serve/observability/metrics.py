"""What is counted, in the workers' shared blocks, and its page for Prometheus over all workers.

Only a worker's event loop writes its block, so an addition needs no lock. A replacement goes on
counting where the worker before it in that block ended: no count ever falls.
Source: Prometheus text exposition format 0.0.4.
"""

from bisect import bisect_left
from collections.abc import Iterator

from serve.api.problems import KINDS, Kind
from serve.scheduling.frame_queue import Perceived
from serve.workers.shared_memory import (
    BEAT,
    CONNECTIONS,
    COUNTS,
    READY,
    SILENT_S,
    WAITING,
    WORKER_WORDS,
    Shared,
)

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BOUNDS_S = (0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0)
STAGES = ("queue", "decode", "forward", "total")
OUTCOMES = ("answered", *(kind.name for kind in KINDS))
OUTCOME = {kind: number for number, kind in enumerate(KINDS, start=1)}
CELLS = len(BOUNDS_S) + 2  # one beyond the last bound, and the sum
FRAMES = COUNTS
DISMISSED = FRAMES + len(OUTCOMES)
HISTOGRAMS = DISMISSED + len(OUTCOMES)
assert HISTOGRAMS + len(STAGES) * CELLS <= WORKER_WORDS


class Metrics:
    """The counts of one worker, and of all."""

    def __init__(self, shared: Shared, slot: int) -> None:
        self._blocks = [shared.worker(number) for number in range(shared.slots)]
        self._mine = self._blocks[slot]

    def answered(self, perceived: Perceived, total_s: float, waiting: int) -> None:
        """Count an answered frame and where its time went."""
        mine = self._mine
        mine[FRAMES] += 1.0
        mine[WAITING] = waiting
        times_ms = (perceived.queue_ms, perceived.decode_ms, perceived.forward_ms, 1e3 * total_s)
        at = HISTOGRAMS
        for time_ms in times_ms:
            seconds = time_ms / 1e3
            mine[at + bisect_left(BOUNDS_S, seconds)] += 1.0
            mine[at + CELLS - 1] += seconds
            at += CELLS

    def refused(self, kind: Kind, waiting: int) -> None:
        """Count a frame that got a problem."""
        self._mine[FRAMES + OUTCOME[kind]] += 1.0
        self._mine[WAITING] = waiting

    def dismissed(self, kind: Kind) -> None:
        """Count a connection that was cut."""
        self._mine[DISMISSED + OUTCOME[kind]] += 1.0

    def page(self, now: float, origin: dict[str, str]) -> str:
        """All counts of all workers; `now` in s of the monotonic clock."""
        return "\n".join([*self._lines(now, origin), ""])

    def _lines(self, now: float, origin: dict[str, str]) -> Iterator[str]:
        alive = [block for block in self._blocks if block[BEAT] > now - SILENT_S]
        labels = ",".join(f'{name}="{value}"' for name, value in origin.items())
        yield from _head("model_info", "gauge", "The model that answers.")
        yield f"driverview_model_info{{{labels}}} 1"
        for name, cell, text in (
            ("connections", CONNECTIONS, "Open connections."),
            ("waiting_frames", WAITING, "Frames in the queues, when a frame last left one."),
            ("workers_ready", READY, "Workers that are warm and have given their golden answer."),
        ):
            yield from _head(name, "gauge", text)
            yield f"driverview_{name} {sum(block[cell] for block in alive):g}"
        yield from _head("workers", "gauge", "Workers that are alive.")
        yield f"driverview_workers {len(alive)}"
        yield from _head("frames_total", "counter", "Frames by what became of them.")
        for number, outcome in enumerate(OUTCOMES):
            yield f'driverview_frames_total{{outcome="{outcome}"}} {self._sum(FRAMES + number):.0f}'
        name = "dismissed_connections_total"
        yield from _head(name, "counter", "Connections that were cut, by why.")
        for number, outcome in enumerate(OUTCOMES[1:], start=1):
            yield f'driverview_{name}{{problem="{outcome}"}} {self._sum(DISMISSED + number):.0f}'
        for number, stage in enumerate(STAGES):
            yield from self._histogram(stage, HISTOGRAMS + number * CELLS)

    def _histogram(self, stage: str, at: int) -> Iterator[str]:
        name = f"{stage}_seconds"
        yield from _head(name, "histogram", f"Time of answered frames: {stage}.")
        count = 0.0
        for number, bound in enumerate((*BOUNDS_S, "+Inf")):
            count += self._sum(at + number)
            yield f'driverview_{name}_bucket{{le="{bound}"}} {count:.0f}'
        yield f"driverview_{name}_sum {self._sum(at + CELLS - 1):.9g}"
        yield f"driverview_{name}_count {count:.0f}"

    def _sum(self, cell: int) -> float:
        return sum(block[cell] for block in self._blocks)


def _head(name: str, kind: str, text: str) -> tuple[str, str]:
    return f"# HELP driverview_{name} {text}", f"# TYPE driverview_{name} {kind}"

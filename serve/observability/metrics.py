"""Counts frames and connections in shared memory, and writes the page of counts for Prometheus.

Each worker has its own block of counters, which only its event loop writes, so an increment needs
no lock. A replacement worker continues the counts in the block of its predecessor, so counters
never decrease. Source: Prometheus text exposition format 0.0.4.
"""

from bisect import bisect_left
from collections.abc import Iterator

from serve.problems import PROBLEM_TYPES, ProblemType
from serve.scheduling.frame import FrameResult
from serve.shared_memory import (
    CLOSED_COUNTS,
    CONNECTIONS,
    FRAME_COUNTS,
    HEARTBEAT,
    HEARTBEAT_TIMEOUT_S,
    HISTOGRAMS,
    READY,
    STAGE_WORDS,
    WAITING,
    SharedMemory,
)

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BOUNDS_S = (0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0)
STAGE_NAMES = ("queue", "decode", "forward", "total")
OUTCOMES = ("answered", *(found.name for found in PROBLEM_TYPES))
OUTCOME_INDEX = {found: number for number, found in enumerate(PROBLEM_TYPES, start=1)}
SUM = STAGE_WORDS - 1  # index of the sum in s in a stage's histogram; the buckets precede it


class Metrics:
    """The counters of one worker, and the page with the totals of all workers."""

    def __init__(self, shared: SharedMemory, block: int) -> None:
        self._blocks = [shared.worker(number) for number in range(shared.blocks)]
        self._own = self._blocks[block]

    def count_answer(self, result: FrameResult, total_s: float, waiting: int) -> None:
        """Count an answered frame and its times; `waiting` is the number of queued frames."""
        own = self._own
        own[FRAME_COUNTS] += 1.0
        own[WAITING] = waiting
        times_ms = (result.queue_ms, result.decode_ms, result.forward_ms, 1e3 * total_s)
        at = HISTOGRAMS
        for time_ms in times_ms:
            seconds = time_ms / 1e3
            own[at + bisect_left(BOUNDS_S, seconds)] += 1.0
            own[at + SUM] += seconds
            at += STAGE_WORDS

    def count_refusal(self, problem_type: ProblemType, waiting: int) -> None:
        """Count a refused frame; `waiting` is the number of queued frames."""
        self._own[FRAME_COUNTS + OUTCOME_INDEX[problem_type]] += 1.0
        self._own[WAITING] = waiting

    def count_closed(self, problem_type: ProblemType) -> None:
        """Count a connection that the service closed because of a problem."""
        self._own[CLOSED_COUNTS + OUTCOME_INDEX[problem_type]] += 1.0

    def page(self, now: float, provenance: dict[str, str]) -> str:
        """Return the metrics of all workers as text for Prometheus. `now` is in s of the monotonic
        clock; `provenance` identifies the served model."""
        return "\n".join([*self._lines(now, provenance), ""])

    def _lines(self, now: float, provenance: dict[str, str]) -> Iterator[str]:
        live = [cells for cells in self._blocks if cells[HEARTBEAT] > now - HEARTBEAT_TIMEOUT_S]
        labels = ",".join(f'{name}="{value}"' for name, value in provenance.items())
        yield from _header("model_info", "gauge", "The served model.")
        yield f"driverview_model_info{{{labels}}} 1"
        for name, cell, text in (
            ("connections", CONNECTIONS, "Open connections."),
            ("waiting_frames", WAITING, "Queued frames at the latest answer or refusal."),
            ("workers_ready", READY, "Workers whose model is warm and has passed its check."),
        ):
            yield from _header(name, "gauge", text)
            yield f"driverview_{name} {sum(cells[cell] for cells in live):g}"
        yield from _header("workers", "gauge", "Live workers.")
        yield f"driverview_workers {len(live)}"
        yield from _header("frames_total", "counter", "Frames by outcome.")
        for number, outcome in enumerate(OUTCOMES):
            count = self._sum(FRAME_COUNTS + number)
            yield f'driverview_frames_total{{outcome="{outcome}"}} {count:.0f}'
        name = "closed_connections_total"
        yield from _header(name, "counter", "Connections closed by the service, by problem.")
        for number, outcome in enumerate(OUTCOMES[1:], start=1):
            count = self._sum(CLOSED_COUNTS + number)
            yield f'driverview_{name}{{problem="{outcome}"}} {count:.0f}'
        for number, stage in enumerate(STAGE_NAMES):
            yield from self._histogram(stage, HISTOGRAMS + number * STAGE_WORDS)

    def _histogram(self, stage: str, at: int) -> Iterator[str]:
        name = f"{stage}_seconds"
        yield from _header(name, "histogram", f"Time of answered frames: {stage}.")
        count = 0.0
        for number, bound in enumerate((*BOUNDS_S, "+Inf")):
            count += self._sum(at + number)
            yield f'driverview_{name}_bucket{{le="{bound}"}} {count:.0f}'
        yield f"driverview_{name}_sum {self._sum(at + SUM):.9g}"
        yield f"driverview_{name}_count {count:.0f}"

    def _sum(self, cell: int) -> float:
        return sum(cells[cell] for cells in self._blocks)


def _header(name: str, metric_type: str, text: str) -> tuple[str, str]:
    return f"# HELP driverview_{name} {text}", f"# TYPE driverview_{name} {metric_type}"

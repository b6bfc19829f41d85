"""How long a piece of work holds the event loop."""

import time
from collections.abc import Callable
from contextlib import suppress

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.problems import Problem

LOOP_S = 0.02  # for which one request may hold the event loop
TRIES, TRYING_S = 5, 5.0  # the quickest counts: the machine may be slower for a second


def held_s(work: Callable[[], object], limit_s: float = LOOP_S) -> float:
    """The least processor time of `work`, s, which may end with a refusal; or one under a limit."""
    least_s, tries, end_s = float("inf"), 0, time.monotonic() + TRYING_S
    while tries < TRIES or (least_s >= limit_s and time.monotonic() < end_s):
        start_s = time.thread_time()
        with suppress(Problem, ImageError):
            work()
        least_s, tries = min(least_s, time.thread_time() - start_s), tries + 1
    return least_s

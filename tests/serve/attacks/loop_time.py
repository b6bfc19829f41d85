"""How long a piece of work holds the event loop."""

import time
from collections.abc import Callable
from contextlib import suppress

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.problems import Problem

LOOP_S = 0.02  # for which one request may hold the event loop
TRIES = 5  # the quickest counts: other programs run on this machine


def held_s(work: Callable[[], object]) -> float:
    """The processor time of `work`, s, which may end with a refusal."""
    times = []
    for _ in range(TRIES):
        start = time.thread_time()
        with suppress(Problem, ImageError):
            work()
        times.append(time.thread_time() - start)
    return min(times)

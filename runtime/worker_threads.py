"""Limits the threads of worker processes, so that all processes together fill the cores."""

import os


def thread_limits(workers: int) -> dict[str, str]:
    """Return the environment variables that give each of `workers` processes its share of the
    cores; libraries read them when they are loaded."""
    share = (os.cpu_count() or 1) // workers
    return {
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }

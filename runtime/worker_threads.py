"""Limits the threads of worker processes, so that all processes together fill the cores."""

import os


def thread_limits(workers: int) -> dict[str, str]:
    """Return environment variables that limit the threads in each of `workers` processes. Mesa's
    software renderer gets the process's share of the cores, or draws in the calling thread if the
    share is one core. OpenMP and OpenBLAS get one thread. The libraries read the variables when
    they are loaded."""
    share = (os.cpu_count() or 1) // workers
    return {
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }

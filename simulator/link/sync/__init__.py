"""Synchronisation in shared memory: sequence lock, atomics, futex."""

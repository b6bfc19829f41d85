"""Random roads: `random:SEED` is a closed road that is a function of its seed."""

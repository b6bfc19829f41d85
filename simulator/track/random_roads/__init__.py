"""Random roads: `random:SEED` is a closed road that its seed determines."""

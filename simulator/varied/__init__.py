"""Varied roads: the random values of each round and scene of `--roads varied`; see ranges.toml."""

ROADS = ("paper", "varied")
"""Kinds of roads: "paper" has lanes of 4.0 m and the tracks' own paint, "varied" random values."""

"""Random values of the rounds and scenes of `--roads varied`; ranges.toml contains their ranges."""

ROADS = ("paper", "varied")
"""Kinds of roads: "paper" has lanes of 4.0 m and the tracks' own paint; "varied" has random lanes,
paint and surroundings."""

"""Roads as they are: what a round or a scene of `--roads varied` is drawn with; see ranges.toml."""

ROADS = ("paper", "varied")
"""Kinds of roads: the paper's with the tracks' own paint, and those drawn from ranges.toml."""

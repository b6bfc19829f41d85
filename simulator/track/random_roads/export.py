"""Writes a random road as a TOML file, which reads back as the same track (see `toml_track`).

simulator tracks export random:7 --out random-7.toml
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from runtime.files import atomic_write
from simulator.track.random_roads.kinds import kind_of
from simulator.track.random_roads.road import random_name, road_file


def write_road(seed: int, path: Path) -> None:
    """Write the road of `seed`. Raises UserError without the folder, OSError for a full disk."""
    atomic_write(path, road_text(seed))


def road_text(seed: int) -> str:
    """The road of `seed` as the text of a TOML file."""
    comment = f"# {random_name(seed)}: a random road of the kind {kind_of(seed).name}."
    return "\n".join([comment, *_lines(road_file(seed))]) + "\n"


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    for key, value in content.items():
        if not isinstance(value, dict | list):
            yield f"{key} = {_literal(value)}"
    for key, value in content.items():
        tables = value if isinstance(value, list) else [value] if isinstance(value, dict) else []
        for table in tables:
            yield from ("", f"[[{key}]]" if isinstance(value, list) else f"[{key}]")
            yield from (f"{name} = {_literal(entry)}" for name, entry in table.items())


def _literal(value: str | bool | float) -> str:
    """`value` as TOML: for plain strings, booleans and numbers this is JSON's text."""
    return json.dumps(value)

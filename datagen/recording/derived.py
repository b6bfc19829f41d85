"""The derived parts of a dataset folder: manifest, split, statistics and the dataset card."""

from pathlib import Path
from typing import Any

from .card import card
from .dataset import Dataset
from .folder import write_synced
from .manifest import MANIFEST, as_text, describe_folder
from .splits import Split, split_path, write_split
from .statistics import describe


def rebuild(folder: Path, split: Split) -> dict[str, Any]:
    """Write manifest, split, statistics and card from the rounds; returns the statistics."""
    write_split(split_path(folder), split)
    dataset = Dataset.open(folder)
    statistics = describe(dataset)
    write_synced(folder / "stats.json", as_text(statistics))
    write_synced(folder / "README.md", card(dataset, statistics))
    write_synced(folder / MANIFEST, as_text(describe_folder(dataset)))
    return statistics

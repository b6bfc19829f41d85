"""Fills the card of an export, `webdataset.md` or `lerobot.md`, which becomes its README.md."""

from importlib.resources import files

from datagen.export.split_sides import Side
from datagen.recording.dataset import Dataset
from runtime.cli import counted


def card(dataset: Dataset, parts: list[Side], kind: str, shard_size: int) -> str:
    """Markdown with the front matter for Hugging Face."""
    counts = ", ".join(
        f"{side.name} {counted(side.frames, 'frame')} of {counted(len(side.rounds), 'round')}"
        for side in parts
    )
    template = files("datagen.export").joinpath(f"{kind}.md").read_text(encoding="utf-8")
    return template.format(
        name=dataset.path.resolve().name,
        counts=counts[0].upper() + counts[1:],
        hash=dataset.content_hash,
        first=parts[0].name,
        last=(parts[0].frames - 1) // shard_size,
    )

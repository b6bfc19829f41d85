"""Exports the rounds of one side of a dataset, or of all sides, into a new folder."""

from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from datagen.export import webdataset
from datagen.export.output_folder import new_folder, require_free
from datagen.export.split_sides import Progress, Side, sides
from datagen.recording.dataset import Dataset
from runtime.cli import counted
from runtime.files import utf8_path
from trackfeatures.errors import UserError

FORMATS = ("webdataset", "lerobot")


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Options of `datagen export`; the command declares their defaults."""

    format: str
    split: str
    shard_size: int
    shuffle: bool

    def validate(self) -> None:
        """Raise UserError for impossible options; called before the dataset is read."""
        if self.format not in FORMATS:
            raise UserError(f"there is no format {self.format!r}; choose {' or '.join(FORMATS)}")
        if self.shard_size < 1:
            raise UserError(f"--shard-size is {self.shard_size}; give at least 1 frame")
        if self.format == "lerobot" and self.shuffle:
            raise UserError("LeRobot's episodes are in order of time; leave out --shuffle")
        if self.format == "lerobot" and find_spec("pyarrow") is None:
            raise UserError(
                "LeRobot's format needs pyarrow, which is not installed; "
                "run `pip install 'driverview[export]'`"
            )


@dataclass(frozen=True, slots=True)
class ExportResult:
    """Result of an export: `out` has `files` files of `bytes` bytes in total. `content_hash` is the
    hash of the exported dataset."""

    format: str
    out: str
    rounds: int
    frames: int
    files: int
    bytes: int
    content_hash: str


def export(folder: Path, out: Path, config: ExportConfig, progress: Progress) -> ExportResult:
    """Export the dataset `folder` to the new folder `out`. `progress` is called with the number of
    frames written so far.

    Raises UserError (DatasetError) or OSError; `out` then does not exist.
    """
    config.validate()
    require_free(out)
    dataset = Dataset.open(folder)
    parts = sides(dataset, config.split)
    with new_folder(out) as partial:
        try:
            _write(partial, dataset, parts, config, progress)
            about = _card(dataset, parts, config.format, config.shard_size)
            (partial / "README.md").write_text(about, encoding="utf-8")
        except OSError as error:
            error.filename = error.filename or str(out)  # a failed write names no file
            raise
        written = [path for path in partial.rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in written)
    return ExportResult(
        format=config.format,
        out=str(out),
        rounds=sum(len(side.rounds) for side in parts),
        frames=sum(side.frames for side in parts),
        files=len(written),
        bytes=size,
        content_hash=dataset.content_hash,
    )


def _write(
    partial: Path, dataset: Dataset, parts: list[Side], config: ExportConfig, progress: Progress
) -> None:
    if config.format == "webdataset":
        webdataset.write(partial, parts, config.shard_size, config.shuffle, progress)
        return
    from datagen.export import lerobot

    with utf8_path(partial / "data") as inside:  # pyarrow takes UTF-8 names only
        lerobot.write(inside.parent, parts, dataset.camera, progress)


def _card(dataset: Dataset, parts: list[Side], kind: str, shard_size: int) -> str:
    """Return the text of the export's README.md: Markdown with front matter for Hugging Face, made
    from the template `webdataset.md` or `lerobot.md`. `parts` are the exported sides, `kind` is the
    format, and `shard_size` the number of frames per WebDataset shard."""
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

"""The recording format: MCAP rounds in a dataset folder, written and read without a simulator.

    from datagen.recording import Dataset

    dataset = Dataset.open("datasets/default")      # or Dataset.open(folder, split="by-track")
    train = dataset.select("train")                 # Frames; also "test", "all"
    labels = train.labels                           # arrays, one row per frame: see Labels
    image = train.image(0)                          # (H, W, 3) uint8 RGB
    batch = train.read_batch([5, 0, 7])             # (3, H, W, 3) uint8, one thread per core

The names listed here are the public interface: they change only with a new version of the program.
`open_round` opens a single round; `integrity/` has verification and recovery.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from datagen.recording.dataset import Dataset as Dataset
    from datagen.recording.dataset import Frames as Frames
    from datagen.recording.errors import DatasetError as DatasetError
    from datagen.recording.errors import UndecodableImage as UndecodableImage
    from datagen.recording.labels import Labels as Labels
    from datagen.recording.mcap.index import RoundIndex as RoundIndex
    from datagen.recording.mcap.index import open_round as open_round
    from datagen.recording.round_metadata import Recovery as Recovery
    from datagen.recording.round_metadata import RoundHeader as RoundHeader
    from datagen.recording.round_metadata import RoundInfo as RoundInfo
    from datagen.recording.round_metadata import RoundResult as RoundResult
    from datagen.recording.splits import Split as Split

_MODULES = {
    "Dataset": "dataset",
    "DatasetError": "errors",
    "Frames": "dataset",
    "Labels": "labels",
    "Recovery": "round_metadata",
    "RoundHeader": "round_metadata",
    "RoundIndex": "mcap.index",
    "RoundInfo": "round_metadata",
    "RoundResult": "round_metadata",
    "Split": "splits",
    "UndecodableImage": "errors",
    "open_round": "mcap.index",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that the help of a command does not import
    numpy."""
    if name not in _MODULES:
        raise AttributeError(f"module 'datagen.recording' has no attribute {name!r}")
    found = getattr(import_module(f"datagen.recording.{_MODULES[name]}"), name)
    globals()[name] = found
    return found

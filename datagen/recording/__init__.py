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

from datagen.recording.dataset import Dataset, Frames
from datagen.recording.errors import DatasetError, UndecodableImage
from datagen.recording.labels import Labels
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.round_metadata import Recovery, RoundHeader, RoundInfo, RoundResult
from datagen.recording.splits import Split

__all__ = [
    "Dataset",
    "DatasetError",
    "Frames",
    "Labels",
    "Recovery",
    "RoundHeader",
    "RoundIndex",
    "RoundInfo",
    "RoundResult",
    "Split",
    "UndecodableImage",
    "open_round",
]

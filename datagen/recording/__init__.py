"""The recording format: MCAP rounds in a dataset folder, written and read without a simulator.

    from datagen.recording import Dataset

    dataset = Dataset.open("datasets/default")      # or Dataset.open(folder, split="by-track")
    train = dataset.select("train")                 # Frames; also "test", "all"
    labels = train.labels                           # arrays, one row a frame: see Labels
    image = train.image(0)                          # (H, W, 3) uint8 RGB
    batch = train.read_batch([5, 0, 7])             # (3, H, W, 3) uint8, decoded on all cores

What is listed here is stable: it changes with a new version of the program only. A round by itself
is opened with `open_round`; `verify` and `recover` look after folders and files.
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

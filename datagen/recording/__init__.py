"""The recording format: MCAP rounds in a dataset folder, written and read without a simulator."""

from .camera import CameraInfo
from .dataset import Dataset, Frames
from .errors import DatasetError
from .header import RoundInfo
from .labels import Labels

__all__ = ["CameraInfo", "Dataset", "DatasetError", "Frames", "Labels", "RoundInfo"]

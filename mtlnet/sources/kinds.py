"""Determines the kind of a file (image, film, recorded round or other recording) by its first
bytes, or else by its name."""

from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Any

import yaml

from mtlnet.inference.image_decoding.other_kinds import SUFFIXES


class SourceKind(Enum):
    """Kind of a source of images."""

    IMAGE = "image"
    FILM = "film"
    ROUND = "round"
    RECORDING = "recording"
    """Recording of another program: an MCAP file of Foxglove or ROS 2, a ROS 2 bag."""
    STREAM = "stream"
    """Webcam or stream."""


IMAGES = tuple(suffix for suffix in SUFFIXES if suffix != ".gif")  # a GIF is read as a film
# fmt: off
FILMS = (
    ".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".ts", ".m2ts", ".mts", ".mpg", ".mpeg",
    ".vob", ".wmv", ".asf", ".flv", ".3gp", ".3g2", ".ogv", ".gif", ".y4m", ".mjpeg", ".mjpg",
    ".h264", ".264", ".avc", ".h265", ".265", ".hevc", ".qcamera",
    ".mxf", ".nut", ".ivf", ".dv", ".gxf", ".wtv", ".rm",
)
# fmt: on
MJPEG = (".mjpeg", ".mjpg")  # they begin like a JPEG image
ROUND, MCAP_START = ".mcap", b"\x89MCAP"
ROUND_NAME, TAIL_BYTES = (
    b"driverview.round",
    1 << 16,
)  # name of a round's metadata record, which is at the file's start or in its index
SQLITE_START = b"SQLite format 3\0"
ZSTD_START = b"\x28\xb5\x2f\xfd"
BAG_METADATA, BAG = "metadata.yaml", "rosbag2_bagfile_information"
HEAD_BYTES = 400
IMAGE_STARTS = (
    b"\xff\xd8\xff", b"\x89PNG", b"BM", b"II*\0", b"MM\0*", b"\0\0\0\x0cjP  ",
    b"P4\n", b"P5\n", b"P6\n",
)  # fmt: skip
IMAGE_BRANDS = (b"avif", b"avis", b"heic", b"heix", b"mif1", b"msf1")
FILM_STARTS = (
    b"\x1aE\xdf\xa3", b"OggS", b"FLV\x01", b"GIF8", b"YUV4MPEG2", b"\0\0\x01\xba", b"\0\0\0\x01",
    b"\0\0\x01", bytes.fromhex("3026b2758e66cf11"),
)  # fmt: skip
MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide")
TS_PACKETS = ((0, 188), (4, 192))  # first sync byte and packet size: MPEG-TS, Blu-ray's MPEG-TS


def kind_of(path: Path) -> SourceKind | None:
    """Return the kind of the file at `path`; None if files of this kind are not read."""
    suffix = path.suffix.lower()
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        head = b""
    if suffix == ROUND or head.startswith(MCAP_START):
        is_round = not head.startswith(MCAP_START) or ROUND_NAME in head + _tail(path)
        return SourceKind.ROUND if is_round else SourceKind.RECORDING
    if head.startswith(SQLITE_START):
        return SourceKind.RECORDING
    if head.startswith(ZSTD_START):
        return SourceKind.RECORDING if compressed_bag_files(path) else None
    found = _kind_of_content(head)
    if found is SourceKind.IMAGE and suffix in MJPEG:
        return SourceKind.FILM
    if found is None and suffix in IMAGES:
        return SourceKind.IMAGE
    return SourceKind.FILM if found is None and suffix in FILMS else found


def _tail(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - TAIL_BYTES, 0))
        return file.read()


def _kind_of_content(head: bytes) -> SourceKind | None:
    if head[:4] == b"RIFF":
        return {b"WEBP": SourceKind.IMAGE, b"AVI ": SourceKind.FILM}.get(head[8:12])
    if head[4:8] in MP4_BOXES:
        return SourceKind.IMAGE if head[8:12] in IMAGE_BRANDS else SourceKind.FILM
    if head.startswith(IMAGE_STARTS):
        return SourceKind.IMAGE
    is_ts = any(head[first : first + 2 * step : step] == b"GG" for first, step in TS_PACKETS)
    return SourceKind.FILM if is_ts or head.startswith(FILM_STARTS) else None


def bag_metadata(folder: Path) -> dict[str, Any] | None:
    """Read the `metadata.yaml` of a ROS 2 bag: the dict under its key
    `rosbag2_bagfile_information`; None if the folder is not a bag."""
    with suppress(OSError, UnicodeDecodeError, yaml.YAMLError):
        found = yaml.safe_load((folder / BAG_METADATA).read_text(encoding="utf-8"))
        if isinstance(found, dict) and isinstance(found.get(BAG), dict):
            return dict(found[BAG])
    return None


def compressed_bag_files(path: Path) -> list[str]:
    """Return the names of all files of the compressed ROS 2 bag to which the file `path` belongs;
    empty if it belongs to none. The messages or the files of such a bag are compressed."""
    about = bag_metadata(path.parent) or {}
    mode, listed = about.get("compression_mode"), about.get("relative_file_paths")
    if not isinstance(listed, list) or str(mode or "none").lower() == "none":
        return []
    names = [Path(str(name)).name for name in listed]
    return names if path.name in names else []

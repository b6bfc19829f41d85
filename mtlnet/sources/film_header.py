"""Reads from the container of a film what OpenCV does not report: missing data at the end of the
file, and pictures that must not be used as they are stored.

Sources: ISO 14496-12 and QuickTime (MP4), RFC 9559 (Matroska), Microsoft's RIFF (AVI) and ASF (WMV)
specifications, RFC 3533 (Ogg), yuv4mpeg(5).
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from runtime.film import boxes

MAX_INDEX_BYTES = 256 << 20
EBML, SEGMENT, TRACKS, TRACK, VIDEO = 0x1A45DFA3, 0x18538067, 0x1654AE6B, 0xAE, 0xE0
STEREO_MODE, CROPS = 0x53B8, (0x54AA, 0x54BB, 0x54CC, 0x54DD)
PROJECTION, YAW, PITCH = 0x7670, 0x7673, 0x7674  # a mirrored picture has a yaw or a pitch
ASF_HEADER = bytes.fromhex("3026b2758e66cf11a6d900aa0062ce6c")
ASF_PROPERTIES = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")
Y4M, Y4M_FRAME, Y4M_LINE_BYTES = b"YUV4MPEG2", b"FRAME\n", 1024
# Pixels per chroma sample, across and down.
Y4M_CHROMA = {b"420": (2, 2), b"411": (4, 1), b"422": (2, 1), b"444": (1, 1)}
OGG_PAGE, OGG_LAST, OGG_TAIL_BYTES = b"OggS", 4, 1 << 17
MP4_FIRST = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"styp")


def missing_end(path: Path) -> str:
    """Return a text about what is missing at the end of the film's file; empty if nothing is
    missing, or if the format states no size (MPEG-TS, raw streams)."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(16)
        if head[4:8] in MP4_FIRST:
            return _missing_in_mp4(file, size)
        if head[:4] == b"RIFF":
            return _missing_in_avi(file, size)
        if head[:4] == OGG_PAGE:
            return _missing_in_ogg(file, size)
        if head[:9] == Y4M:
            return _missing_in_y4m(file, size)
        if head == ASF_HEADER:
            stated = _asf_size(file)
        elif head[:4] == EBML.to_bytes(4, "big"):
            ends = (end for kind, _, end in _elements(file, 0, size) if kind == SEGMENT)
            stated = max(ends, default=0)
        else:
            stated = 0
    return f"it states {stated} bytes and has {size}" if stated > size else ""


def unsupported_picture(path: Path) -> str:
    """Return a text about why the film's pictures must not be used as they are stored
    (cropped, mirrored, stereoscopic); empty if they can be used."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(16)
        if head[4:8] in MP4_FIRST:
            return next(_mp4_pictures(file, size), "")
        if head[:4] == EBML.to_bytes(4, "big"):
            return next(_matroska_pictures(file, size), "")
    return ""


def stated_frames(path: Path, counted: int) -> int:
    """Return the exact number of frames that a film must have; 0 if its container does not state
    it.

    For an AVI it is the number of frames in the index, without empty frames. For a Y4M it is
    `counted`, OpenCV's number, which is computed from the file's size. Other containers state only
    an estimate; there the decoder reports missing frames.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(9)
        if head == Y4M:
            return counted
        if head[:4] != b"RIFF":
            return 0
        riffs = list(_chunks(file, 0, size))
        if len(riffs) != 1:
            return 0  # over 1 GiB: a part of the index is elsewhere
        for kind, start, end in _chunks(file, 12, size):
            if kind == b"idx1" and end - start <= MAX_INDEX_BYTES:
                file.seek(start)
                data = file.read(end - start)
                entries = np.frombuffer(data[: len(data) // 16 * 16], "S4,<u4,<u4,<u4")
                names = np.ascontiguousarray(entries["f0"]).view("S1").reshape(-1, 4)
                pictures = (names[:, 2] == b"d") & np.isin(names[:, 3], (b"c", b"b"))
                return int((pictures & (entries["f3"] > 0)).sum())
    return 0


def _missing_in_mp4(file: BinaryIO, size: int) -> str:
    end, kinds = 0, set()
    for kind, _, end in boxes(file, 0, size):
        kinds.add(kind)
        if end > size:
            return f"its part {kind.decode()!r} ends {end - size} bytes beyond the end of the file"
    file.seek(end)
    if b"moof" in kinds and any(file.read(1 << 16)):  # zeros are padding
        return f"it is damaged at byte {end}, and its parts cannot be found from there on"
    return ""


def _mp4_pictures(file: BinaryIO, size: int) -> Iterator[str]:
    for kind, start, end in boxes(file, 0, size):
        if kind != b"moov" or end > size or end - start > MAX_INDEX_BYTES:
            continue
        for track, track_start, track_end in boxes(file, start, end):
            if track != b"trak":
                continue
            file.seek(track_start)
            content = file.read(track_end - track_start)
            if b"vide" not in content:
                continue
            if _is_mirrored(content):
                yield "its header mirrors the picture"
            if _is_cut(content):
                yield "its header shows a part of the picture only (clap)"
            if b"st3d" in content and content[content.index(b"st3d") + 8 :][:1] != b"\0":
                yield "it holds pictures for two eyes (st3d)"


def _is_mirrored(track: bytes) -> bool:
    """Whether the matrix of the track header mirrors the picture."""
    at = track.find(b"tkhd") + 4
    matrix_at = at + (52 if track[at : at + 1] == b"\1" else 40)
    if at < 4 or len(track) < matrix_at + 20:
        return False
    a, b, _, c, d = struct.unpack_from(">5i", track, matrix_at)
    return bool(a * d - b * c < 0)


def _is_cut(track: bytes) -> bool:
    """Whether the clean aperture is smaller than the picture of the sample entry."""
    at = track.find(b"clap", track.find(b"stsd"))
    described = track.find(b"stsd") + 4 + 8  # version, flags and count are passed over
    if at < 0 or described < 12 or len(track) < max(at + 36, described + 36):
        return False
    numbers = struct.unpack_from(">4I", track, at + 4)
    width, height = struct.unpack_from(">2H", track, described + 32)
    return bool(numbers[0] < width * numbers[1] or numbers[2] < height * numbers[3])


def _matroska_pictures(file: BinaryIO, size: int) -> Iterator[str]:
    """Problems of the tracks before the first cluster, where all writers place them."""
    for _, segment, _ in (e for e in _elements(file, 0, size) if e[0] == SEGMENT):
        for _, tracks, tracks_end in (
            e for e in _elements(file, segment, size, last=TRACKS) if e[0] == TRACKS
        ):
            for kind, track, track_end in _elements(file, tracks, tracks_end):
                if kind == TRACK:
                    yield from _matroska_track(file, track, track_end)


def _matroska_track(file: BinaryIO, start: int, end: int) -> Iterator[str]:
    for kind, video, video_end in _elements(file, start, end):
        if kind != VIDEO:
            continue
        for name, at, after in _elements(file, video, video_end):
            file.seek(at)
            value = int.from_bytes(file.read(after - at), "big")
            if name in CROPS and value:
                yield "its header shows a part of the picture only (PixelCrop)"
            if name == STEREO_MODE and value:
                yield "it holds pictures for two eyes (StereoMode)"
            if name == PROJECTION and any(
                kind in (YAW, PITCH) and _float(file, value_at, value_end)
                for kind, value_at, value_end in list(_elements(file, at, after))
            ):
                yield "its header mirrors or tilts the picture (ProjectionPose)"


def _float(file: BinaryIO, start: int, end: int) -> float:
    """The float in an EBML element; 0 if the element does not have 4 or 8 bytes."""
    file.seek(start)
    data = file.read(end - start)
    form = {4: ">f", 8: ">d"}.get(len(data))
    return float(struct.unpack(form, data)[0]) if form else 0.0


def _elements(
    file: BinaryIO, start: int, end: int, last: int | None = None
) -> Iterator[tuple[int, int, int]]:
    """Yields id, start and end of the content of each EBML element between bytes `start` and `end`.

    `last`: id of the element after which to stop. An element of unknown size extends to `end`.
    """
    while start < end:
        file.seek(start)
        head = file.read(12)
        if not head or not head[0]:
            return
        id_bytes = 9 - head[0].bit_length()
        if id_bytes > 4 or len(head) < id_bytes + 1 or not head[id_bytes]:
            return
        size_bytes = 9 - head[id_bytes].bit_length()
        found = int.from_bytes(head[id_bytes : id_bytes + size_bytes], "big")
        unknown = (1 << 7 * size_bytes) - 1
        size = found & unknown
        content = start + id_bytes + size_bytes
        kind = int.from_bytes(head[:id_bytes], "big")
        start = end if size == unknown else content + size
        yield kind, content, start
        if kind == last:
            return


def _chunks(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yields type, start and end of the content of each RIFF chunk between the given bytes."""
    while start + 8 <= end:
        file.seek(start)
        kind, size = struct.unpack("<4sI", file.read(8))
        if not kind.isalnum() and kind != b"LIST":
            return
        yield kind, start + 8, start + 8 + size
        start += 8 + size + size % 2


def _missing_in_avi(file: BinaryIO, size: int) -> str:
    for kind, _, end in _chunks(file, 0, size):
        if kind == b"RIFF" and end > size:
            return f"it states {end} bytes and has {size}"
    return ""


def _missing_in_ogg(file: BinaryIO, size: int) -> str:
    file.seek(max(size - OGG_TAIL_BYTES, 0))
    tail = file.read()
    at = tail.rfind(OGG_PAGE)
    if at < 0 or at + 6 > len(tail) or not tail[at + 5] & OGG_LAST:
        return "its last page is missing"
    return ""


def _missing_in_y4m(file: BinaryIO, size: int) -> str:
    """A text about what is missing at the end of a Y4M file; empty if nothing is missing. The
    frames must have no parameters; no writer adds any."""
    file.seek(0)
    fields = file.readline(Y4M_LINE_BYTES).split()
    start = file.tell()
    sizes = {field[:1]: int(field[1:]) for field in fields[1:] if field[1:].isdigit()}
    colours = next((field[1:] for field in fields[1:] if field[:1] == b"C"), b"420")
    width, height = sizes.get(b"W", 0), sizes.get(b"H", 0)
    across, down = next((s for name, s in Y4M_CHROMA.items() if colours.startswith(name)), (0, 0))
    samples = width * height + (2 * -(-width // across) * -(-height // down) if across else 0)
    is_known = across or colours.startswith(b"mono")
    frame = len(Y4M_FRAME) + samples * (2 if re.search(rb"[po]1[0-6]$", colours) else 1)
    rest = (size - start) % frame
    if is_known and b"alpha" not in colours and rest and file.readline(8) == Y4M_FRAME:
        return f"its last frame has {rest} of {frame} bytes"
    return ""


def _asf_size(file: BinaryIO) -> int:
    """Size of the file, bytes, in the header of an ASF file; 0 for a broadcast."""
    file.seek(0)
    header = file.read(1 << 16)
    at = header.find(ASF_PROPERTIES)
    if at < 0 or at + 92 > len(header):
        return 0
    (stated,) = struct.unpack_from("<Q", header, at + 40)
    (flags,) = struct.unpack_from("<I", header, at + 88)
    return 0 if flags & 1 else int(stated)

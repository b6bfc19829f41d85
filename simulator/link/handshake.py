"""The header of the shared memory, which the server writes and the client checks and reads."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.link import layout
from simulator.link.errors import LayoutMismatch
from simulator.link.layout import HEADER, IDENTITY, MAGIC, Mode, Phase
from simulator.link.segment import Segment
from simulator.link.sync.seqlock import get_word, set_word


@dataclass(frozen=True)
class ServerInfo:
    """The properties of a server that do not change while it runs. Lengths in m, `steering_lock`
    and `beam_angles` (19,) in rad, image size in px, `engine_pid` is the server's process id."""

    track: str
    lanes: int
    lane_width: float
    track_length: float
    half_width: float
    edge: float
    steering_lock: float
    traffic: int
    frequency_hz: int
    mode: Mode
    image_width: int
    image_height: int
    engine_pid: int
    beam_angles: tuple[float, ...]


def write_header(segment: Segment, info: ServerInfo) -> None:
    """Write the header with the server's properties `info` into a new segment, before
    `Segment.publish` makes the segment visible to clients."""
    record = _record(segment)
    record["magic"] = MAGIC
    record["byte_order"] = layout.BYTE_ORDER
    record["version"] = layout.VERSION
    record["layout_hash"] = layout.layout_hash()
    record["segment_size"] = len(segment.memory)
    record["image_bytes"] = layout.image_bytes(info.image_width, info.image_height)
    record["phase"] = Phase.OPEN
    for field in fields(ServerInfo):
        value = getattr(info, field.name)
        record[field.name] = _truncate(value) if isinstance(value, str) else value


def read_header(segment: Segment) -> ServerInfo:
    """Return the server's properties. Raises LayoutMismatch if the server uses another memory
    layout."""
    check_identity(segment)
    record = _record(segment)
    values = {field.name: record[field.name].item() for field in fields(ServerInfo)[1:-1]}
    values["mode"] = Mode(values["mode"])
    return ServerInfo(
        track=record["track"].decode(),
        beam_angles=tuple(record["beam_angles"].tolist()),
        **values,
    )


def check_identity(segment: Segment) -> None:
    """Raises LayoutMismatch unless the server uses the layout of this program."""
    name, size = segment.name, len(segment.memory)
    if size < IDENTITY.itemsize:
        raise LayoutMismatch(f"the segment {name} has {size} bytes, too few for a link's header")
    found: Any = np.frombuffer(segment.memory, IDENTITY, count=1)[0]
    swapped = int.from_bytes(layout.BYTE_ORDER.to_bytes(4, "big"), "little")
    if found["byte_order"] == swapped:
        raise LayoutMismatch(
            f"the server of {name} writes the other byte order; run both sides on one machine"
        )
    theirs = int(found["version"]), int(found["layout_hash"])
    ours = layout.VERSION, layout.layout_hash()
    if theirs != ours:
        raise LayoutMismatch(
            f"the server of {name} writes layout {theirs[0]} ({theirs[1]:016x}), this client reads "
            f"layout {ours[0]} ({ours[1]:016x}); use the same version of driverview on both sides"
        )
    stated = int(found["segment_size"])
    if size < HEADER.end or not size == stated == layout.STATE.end + _image_bytes(segment):
        raise LayoutMismatch(
            f"the segment {name} has {size} bytes and its header says {stated}; it is damaged: "
            "start the server again"
        )


def _image_bytes(segment: Segment) -> int:
    return int(_record(segment)["image_bytes"])


def phase(segment: Segment) -> Phase:
    return Phase(int(get_word(_phase_word(segment))))


def set_phase(segment: Segment, value: Phase) -> None:
    """Store in the header whether the server is running. A client that reads the new value also
    sees everything that was written before it."""
    set_word(_phase_word(segment), int(value))


def _record(segment: Segment) -> Any:
    """Return the header as a record with field names that views the shared memory."""
    return np.frombuffer(segment.memory, HEADER.dtype, count=1)[0]


def _phase_word(segment: Segment) -> NDArray[np.uint32]:
    place, size = HEADER.places["phase"]
    return segment.bytes()[place : place + size].view(np.uint32)


def _truncate(text: str) -> bytes:
    """Return `text` as UTF-8, cut so that it fits its field of 64 bytes with a terminating 0."""
    return text.encode()[:63].decode(errors="ignore").encode()

"""The layout of the link's shared memory: the single definition, as tables of typed fields.

Three blocks, then the camera image: HEADER (written once by the server), COMMAND (written by the
client) and STATE (written by the server). Native byte order; all padding is explicit; each block is
a multiple of a cache line. `simulator link --header FILE` generates a C header from the tables. A
change of the tables must increase VERSION; a forgotten increase is caught by the layout hash.
"""

import hashlib
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, Final

import numpy as np

from simulator.vehicle.car import WHEELS

MAGIC: Final = b"DRVLINK\0"
VERSION: Final = 1
BYTE_ORDER: Final = 0x01020304
"""Reads 0x04030201 on a machine of the other byte order."""
BEAMS: Final = 19
ERROR_BYTES: Final = 256
CACHE_LINE: Final = 64
MESSAGE_ALIGNMENT: Final = 8
"""A message is copied in words of 8 bytes."""


class Phase(IntEnum):
    """Whether the server is running (HEADER.phase)."""

    OPEN = 1
    CLOSED = 2


class Mode(IntEnum):
    """Whether the server waits for commands or steps by the wall clock (HEADER.mode)."""

    LOCK_STEP = 0
    REALTIME = 1


class Request(IntEnum):
    """The client's request (COMMAND.request)."""

    STEP = 1
    RESET = 2
    LEAVE = 3
    QUIT = 4


class Refusal(IntEnum):
    """Why the server refused the last command (STATE.error)."""

    NONE = 0
    NO_EPISODE = 1
    EPISODE_ENDED = 2
    BAD_COMMAND = 3
    BAD_RESET = 4
    UNKNOWN_REQUEST = 5
    BAD_CHECKSUM = 6


class Ended(IntEnum):
    """Why the episode has ended (STATE.ended); names are those of `simulator.env.reward.Ending`."""

    NOT = 0
    OFF_TRACK = 1
    BACKWARDS = 2
    COLLISION = 3


class Collision(IntEnum):
    """What the car touched during the last step (STATE.collision)."""

    NONE = 0
    TRAFFIC = 1
    WALL = 2


ENUMS: Final = (Phase, Mode, Request, Refusal, Ended, Collision)

C_TYPES: Final = {
    "u4": "uint32_t",
    "i4": "int32_t",
    "u8": "uint64_t",
    "i8": "int64_t",
    "f8": "double",
    "char": "char",
}


@dataclass(frozen=True)
class Field:
    """One named value, or `count` of them; `kind` is a key of C_TYPES."""

    name: str
    kind: str
    unit: str
    meaning: str
    count: int = 1

    @property
    def numpy_format(self) -> str | tuple[str, tuple[int]]:
        if self.kind == "char":
            return f"S{self.count}"
        return self.kind if self.count == 1 else (self.kind, (self.count,))


@dataclass(frozen=True)
class Block:
    """A C struct; `offset` is where it lies in the segment."""

    name: str
    meaning: str
    fields: tuple[Field, ...]
    offset: int

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The structured dtype, with the alignment of a C compiler."""
        return np.dtype([(f.name, f.numpy_format) for f in self.fields], align=True)

    @property
    def places(self) -> dict[str, tuple[int, int]]:
        """Offset in the block and size, in bytes, of each field by name."""
        laid: Any = self.dtype.fields
        return {f.name: (int(laid[f.name][1]), laid[f.name][0].itemsize) for f in self.fields}

    @property
    def end(self) -> int:
        return self.offset + self.dtype.itemsize


def _f(name: str, unit: str, meaning: str, count: int = 1) -> Field:
    return Field(name, "f8", unit, meaning, count)


def _u4(name: str, meaning: str) -> Field:
    return Field(name, "u4", "", meaning)


def _u8(name: str, meaning: str) -> Field:
    return Field(name, "u8", "", meaning)


_SEQUENCE: Final = (
    _u4("sequence", "odd while it is being written; the futex"),
    _u4("spare", "0"),
)
_CHECK: Final = _u8("check", "FNV-1a over the 8-byte words between the first and this")

# The first five fields have the same offsets in every version, so that any two versions can compare
# them.
_IDENTITY: Final = (
    Field("magic", "char", "", '"DRVLINK"', len(MAGIC)),
    _u4("byte_order", "DRVLINK_BYTE_ORDER as the server writes it"),
    _u4("version", "DRVLINK_VERSION of the server"),
    _u8("layout_hash", "DRVLINK_LAYOUT_HASH of the server"),
    _u8("segment_size", "bytes, the picture included"),
)

HEADER: Final = Block(
    "header",
    "What does not change while the server runs, but for `phase`.",
    (
        *_IDENTITY,
        _u4("phase", "enum drvlink_phase"),
        _u4("mode", "enum drvlink_mode"),
        _u8("engine_pid", "of the server, for messages only: the locks show who is running"),
        _u4("frequency_hz", "control steps in a simulated second"),
        _u4("lanes", "lanes of the road"),
        _f("lane_width", "m", "of each lane"),
        _f("track_length", "m", "along the centre line"),
        _f("half_width", "m", "of the track's own width: the reward's scale"),
        _f("edge", "m", "from the centre to where off the track begins"),
        _f("steering_lock", "rad", "front-wheel angle at steer = 1"),
        _u4("traffic", "number of other cars"),
        _u4("image_width", "pixels; 0 without a camera"),
        _u4("image_height", "pixels; 0 without a camera"),
        _u4("image_bytes", "3 bytes a pixel, rounded up to 8"),
        _f("beam_angles", "rad", "from the car's heading, left positive", BEAMS),
        Field("track", "char", "", "the track's name, UTF-8, ends with 0", 64),
        Field("reserved", "char", "", "0", 56),
    ),
    0,
)

COMMAND: Final = Block(
    "command",
    "Client to server.",
    (
        *_SEQUENCE,
        _u8("number", "of this command, counted up by the client"),
        _u8("session", "one more than the value found when the client connected"),
        _u8("seen", "number of the newest state message read: the step acknowledged"),
        _u4("request", "enum drvlink_request"),
        _u4("client_pid", "for messages only"),
        _f("steer", "1", "-1 to 1, left positive; front-wheel angle / lock"),
        _f("throttle", "1", "0 to 1"),
        _f("brake", "1", "0 to 1"),
        Field("gear", "i4", "", "-1 reverse, 0 neutral, 1 to 6"),
        _u4("spare2", "0"),
        Field("seed", "i8", "", "RESET: fixes the episode; negative: the server chooses"),
        _f("start_s", "m", "RESET: place along the centre line; NaN: 25 m before the line"),
        _f("start_to_middle", "m", "RESET: left of the centre line"),
        _f("start_angle", "rad", "RESET: track tangent minus yaw, right positive"),
        _f("start_speed", "m/s", "RESET: along the body"),
        Field("reserved", "char", "", "0", 72),
        _CHECK,
    ),
    HEADER.end,
)

STATE: Final = Block(
    "state",
    "Server to client; the picture, if there is a camera, belongs to the same message.",
    (
        *_SEQUENCE,
        _u8("number", "of this message since the server began"),
        _u8("session", "of the command answered"),
        _u8("answers", "number of the last command taken"),
        _u4("error", "enum drvlink_refusal of that command; the state is as before it"),
        _u4("ended", "enum drvlink_ended: a reset is needed"),
        _u8("episode", "resets since the server began; 0: none yet"),
        _u8("step", "control steps since the reset"),
        _u8("late_steps", "REALTIME: late steps of this episode"),
        Field("seed", "i8", "", "of the episode"),
        _f("time_s", "s", "since the reset"),
        _f("x", "m", "centre of gravity, world frame"),
        _f("y", "m", "centre of gravity, world frame"),
        _f("z", "m", "centre of gravity, world frame, up"),
        _f("yaw", "rad", "counter-clockwise"),
        _f("pitch", "rad", "positive nose down"),
        _f("roll", "rad", "about the body's forward axis"),
        _f("vx", "m/s", "along the body, forward positive"),
        _f("vy", "m/s", "to the body's left"),
        _f("yaw_rate", "rad/s", "counter-clockwise"),
        _f("s", "m", "along the centre line, in [0, track_length)"),
        _f("to_middle", "m", "left of the centre line"),
        _f("angle", "rad", "track tangent minus yaw: pointing right is positive"),
        _f("curvature", "1/m", "of the centre line, left positive"),
        _f("rpm", "rev/min", "of the engine"),
        _f("wheel_spin", "rad/s", f"of the wheels: {', '.join(WHEELS)}", len(WHEELS)),
        _f("steer", "1", "actual front-wheel angle / lock"),
        _f("odometer_m", "m", "driven since the reset"),
        _f("lap_time_s", "s", "since the line was crossed last"),
        Field("lap", "i4", "", "lines crossed since the reset"),
        Field("gear", "i4", "", "-1 reverse, 0 neutral, 1 to 6"),
        _u4("collision", "enum drvlink_collision"),
        _u4("off_track", "1 if so"),
        _u4("backwards", "1 if so"),
        _u4("heading", "class of the road ahead: 0 left, 1 straight, 2 right"),
        _f("reward", "1", "of this step, lambda = 1; -2 when it ended the episode"),
        _f("score", "1", "sum of the rewards since the reset"),
        _f("ml", "m", "to the lane's left marking, left negative; NaN: none"),
        _f("mr", "m", "to the lane's right marking"),
        _f("l", "m", "to the marking left of the one driven on"),
        _f("m", "m", "to the marking driven on"),
        _f("r", "m", "to the marking right of the one driven on"),
        _f("to_lane_centre", "m", "left of the lane's centre; NaN: no lane near"),
        _f("ranges", "m", "to the track's edge along beam_angles, at most 200; -1 off it", BEAMS),
        _f("ranges_traffic", "m", "the same, ending at traffic too", BEAMS),
        Field("error_text", "char", "", "what is wrong with the command, UTF-8", ERROR_BYTES),
        Field("reserved", "char", "", "0", 56),
        _CHECK,
    ),
    COMMAND.end,
)

BLOCKS: Final = (HEADER, COMMAND, STATE)
IMAGE_OFFSET: Final = STATE.end
IDENTITY: Final = np.dtype([(f.name, f.numpy_format) for f in _IDENTITY], align=True)


def image_bytes(width: int, height: int) -> int:
    """Bytes of the picture's area: RGB, rows from top to bottom, rounded up to whole words."""
    return -(-width * height * 3 // MESSAGE_ALIGNMENT) * MESSAGE_ALIGNMENT


def segment_size(width: int, height: int) -> int:
    return IMAGE_OFFSET + image_bytes(width, height)


def layout_hash() -> int:
    """64 bits over all names, types, counts, places and enumerations."""
    parts = [f"{block.name}@{block.offset}" for block in BLOCKS]
    parts += [f"{f.name}:{f.kind}x{f.count}" for block in BLOCKS for f in block.fields]
    parts += [f"{kind.__name__}.{m.name}={m.value}" for kind in ENUMS for m in kind]
    return int.from_bytes(hashlib.sha256("\n".join(parts).encode()).digest()[:8], "big")

"""The layout of the link's shared memory, which the tables in layout.toml define.

The memory consists of three blocks and the camera image: HEADER (the server writes it once),
COMMAND (the client writes it) and STATE (the server writes it). All values have the machine's byte
order. `simulator link --header FILE` generates a C header from the tables. A change of the tables
must increase VERSION. If VERSION was not increased, the layout hash still detects the change.
"""

import hashlib
import tomllib
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from importlib.resources import files
from typing import Any, Final

import numpy as np

MAGIC: Final = b"DRVLINK\0"
VERSION: Final = 1
BYTE_ORDER: Final = 0x01020304
"""A value that reads as 0x04030201 on a machine with the other byte order."""
MESSAGE_ALIGNMENT: Final = 8
"""Size in bytes of the words in which a message is copied."""


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
    """Why the episode has ended (STATE.ended); named as in `simulator.env.reward.Ending`."""

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
    """One field of a block: a single value, or an array of `count` values. `kind` is a key of
    C_TYPES, which contains the C type; `char` stands for a text of `count` bytes."""

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
    """A C struct; `offset` is its position in the segment, in bytes."""

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
        """Offset in the block and size, both in bytes, of each field by name."""
        laid: Any = self.dtype.fields
        return {f.name: (int(laid[f.name][1]), laid[f.name][0].itemsize) for f in self.fields}

    @property
    def end(self) -> int:
        return self.offset + self.dtype.itemsize


def _read_blocks() -> list[Block]:
    """Read the blocks of layout.toml; each begins where the previous one ends."""
    text = files("simulator.link").joinpath("layout.toml").read_text(encoding="utf-8")
    blocks: list[Block] = []
    for name, block in tomllib.loads(text).items():
        table = tuple(Field(*row) for row in block["fields"])
        blocks.append(Block(name, block["meaning"], table, blocks[-1].end if blocks else 0))
    return blocks


HEADER, COMMAND, STATE = _read_blocks()
BLOCKS: Final = (HEADER, COMMAND, STATE)
IMAGE_OFFSET: Final = STATE.end
IDENTITY: Final = np.dtype([(f.name, f.numpy_format) for f in HEADER.fields[:5]], align=True)
"""The fields that are the same in every version of the layout: magic to segment_size."""
BEAMS: Final = HEADER.places["beam_angles"][1] // 8
ERROR_BYTES: Final = STATE.places["error_text"][1]


def image_bytes(width: int, height: int) -> int:
    """Return the size in bytes of the memory of an RGB image of `width` x `height` px, rounded up
    to a multiple of 8. The rows are stored from the top."""
    return -(-width * height * 3 // MESSAGE_ALIGNMENT) * MESSAGE_ALIGNMENT


def segment_size(width: int, height: int) -> int:
    return IMAGE_OFFSET + image_bytes(width, height)


def layout_hash() -> int:
    """Return a 64-bit hash of all field names, types, counts, block offsets and enumerations."""
    parts = [f"{block.name}@{block.offset}" for block in BLOCKS]
    parts += [f"{f.name}:{f.kind}x{f.count}" for block in BLOCKS for f in block.fields]
    parts += [f"{kind.__name__}.{m.name}={m.value}" for kind in ENUMS for m in kind]
    return int.from_bytes(hashlib.sha256("\n".join(parts).encode()).digest()[:8], "big")

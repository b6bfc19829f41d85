"""A named POSIX shared memory segment with two ends, and locks that tell which of them are held.

Each end holds an open-file-description lock on a byte of its own. The kernel releases it with the
process, however that ends, so a lock is never stale: no pid to be reused, no heartbeat to be late,
and it holds between containers that share /dev/shm but not their process numbers. Who holds the
engine's lock may remove the segment, nobody else.

Not `multiprocessing.shared_memory`: its resource tracker removes the segment of a living engine
when a client of another process tree ends.
"""

import fcntl
import mmap
import os
import struct
import time
import weakref
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simulator.link.errors import LinkError, NameInUse, NoEngine
from simulator.link.layout import MAGIC

SHM = Path("/dev/shm")
"""Where Linux keeps POSIX shared memory."""
LONGEST_NAME = 250
CLEANING_S = 0.2
FLOCK = "hhqqi4x"  # struct flock: type, whence, start, length, pid


class End(IntEnum):
    """Which byte of the segment an end locks."""

    ENGINE = 0
    CLIENT = 1


@dataclass(eq=False)
class Segment:
    """A mapped segment of which we hold one end."""

    name: str
    end: End
    descriptor: int
    memory: mmap.mmap

    def bytes(self) -> NDArray[np.uint8]:
        """All of it, shared with the other end."""
        return np.frombuffer(self.memory, dtype=np.uint8)

    def other_end_lives(self) -> bool:
        """Whether somebody holds the other end."""
        return is_held(self.descriptor, End(1 - self.end))

    def publish(self) -> None:
        """Give a new segment, complete by now, its name; that of a dead engine makes way.

        Raises NameInUse, LinkError; see `clear`.
        """
        folder = os.open(SHM, os.O_RDONLY)
        try:
            while True:
                try:
                    # With a folder's descriptor it is linkat, which follows the link in /proc.
                    ours = f"/proc/self/fd/{self.descriptor}"
                    os.link(ours, _path(self.name), src_dir_fd=folder, follow_symlinks=True)
                except FileExistsError:
                    clear(self.name)
                else:
                    return
        finally:
            os.close(folder)

    def close(self) -> None:
        """Give our end back; without a living engine the segment is removed.

        The memory itself stays mapped as long as there are views of it.
        """
        if self.descriptor >= 0:
            _remove_if_dead(self.name, self.descriptor)
            os.close(self.descriptor)
            self.descriptor = -1


_open: "weakref.WeakSet[Segment]" = weakref.WeakSet()


def _forget_in_child() -> None:
    """A forked child shares our locks and would keep them beyond our death."""
    for segment in _open:
        if segment.descriptor >= 0:
            os.close(segment.descriptor)
            segment.descriptor = -1


os.register_at_fork(after_in_child=_forget_in_child)


def check_name(name: str) -> str:
    """`name` itself. Raises LinkError unless it can name a segment everywhere: /letters."""
    if not name.startswith("/") or len(name) < 2:
        raise LinkError(f"the link's name is {name!r}; it begins with a slash: /driverview")
    if "/" in name[1:] or "\0" in name or name in ("/.", "/.."):
        raise LinkError(f"the link's name is {name!r}; give one slash and then a plain name")
    if len(os.fsencode(name)) > LONGEST_NAME:
        raise LinkError(
            f"the link's name has {len(os.fsencode(name))} bytes; give at most {LONGEST_NAME}"
        )
    return name


def create(name: str, size: int) -> Segment:
    """A segment of zeros, our end the engine's; nobody sees it before it is published.

    The memory is claimed now: a write to a page that there is no room for would be a bus error.
    Raises LinkError when there is no room.
    """
    check_name(name)
    descriptor = os.open(SHM, os.O_TMPFILE | os.O_RDWR, 0o600)
    try:
        os.posix_fallocate(descriptor, 0, size)
        try_lock(descriptor, End.ENGINE)
        return _mapped(name, End.ENGINE, descriptor)
    except OSError as error:
        os.close(descriptor)
        raise LinkError(
            f"there is no room for {size} bytes of shared memory ({error.strerror}); free some in "
            f"{SHM}, enlarge it (docker: --shm-size), or choose a smaller --camera"
        ) from error


def clear(name: str) -> None:
    """Remove the segment of a dead engine, if there is one.

    Raises NameInUse when its engine lives, LinkError when it is another program's.
    """
    try:
        descriptor = _open_name(check_name(name), os.O_RDWR)
    except FileNotFoundError:
        return
    try:
        _check_is_link(name, descriptor)
        until = time.monotonic() + CLEANING_S
        while not try_lock(descriptor, End.ENGINE):
            # A client that removes a dead engine's segment holds this lock for a moment.
            if time.monotonic() > until:
                raise NameInUse(
                    f"an engine of the link {name} is running; end it, or choose another --name"
                )
            time.sleep(CLEANING_S / 20)
        _remove_if_dead(name, descriptor)
    finally:
        os.close(descriptor)


def attach(name: str) -> Segment:
    """The segment of a living engine, our end the client's.

    Raises NoEngine when there is none (a dead engine's segment is removed), NameInUse when another
    client is there.
    """
    check_name(name)
    try:
        descriptor = _open_name(name, os.O_RDWR)
    except FileNotFoundError:
        raise NoEngine(
            f"there is no engine of the link {name}; start one: simulator link --name {name}"
        ) from None
    try:
        _check_is_link(name, descriptor)
        if not is_held(descriptor, End.ENGINE):
            _remove_if_dead(name, descriptor)
            raise NoEngine(f"the engine of {name} has died; start it again")
        if not try_lock(descriptor, End.CLIENT):
            raise NameInUse(
                f"the engine of {name} has a client already, and serves one at a time; end that "
                "one, or start another engine under another name"
            )
        return _mapped(name, End.CLIENT, descriptor)
    except BaseException:
        os.close(descriptor)
        raise


def _mapped(name: str, end: End, descriptor: int) -> Segment:
    # An opening of its own: mmap keeps a copy of the descriptor it gets, and with it our lock.
    mapped = os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR)
    try:
        memory = mmap.mmap(mapped, os.fstat(mapped).st_size)
    finally:
        os.close(mapped)
    segment = Segment(name, end, descriptor, memory)
    _open.add(segment)
    return segment


def _check_is_link(name: str, descriptor: int) -> None:
    """Raises LinkError for the memory of another program."""
    start = os.pread(descriptor, len(MAGIC), 0)
    if start != MAGIC:
        raise LinkError(
            f"the shared memory {name} is no link of this program (it begins with {start!r}); "
            "choose another --name"
        )


def _remove_if_dead(name: str, descriptor: int) -> None:
    """Remove a segment whose engine is dead, unless another engine has the name by now."""
    if try_lock(descriptor, End.ENGINE) and _is_named(name, descriptor):
        _path(name).unlink()


def is_held(descriptor: int, end: End) -> bool:
    """Whether another process (or another opening of the segment) holds `end`."""
    wanted = struct.pack(FLOCK, fcntl.F_WRLCK, os.SEEK_SET, end, 1, 0)
    found = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, wanted)
    return bool(struct.unpack(FLOCK, found)[0] != fcntl.F_UNLCK)


def try_lock(descriptor: int, end: End) -> bool:
    """Take `end` for as long as the descriptor is open; False when somebody else has it."""
    wanted = struct.pack(FLOCK, fcntl.F_WRLCK, os.SEEK_SET, end, 1, 0)
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, wanted)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _is_named(name: str, descriptor: int) -> bool:
    """Whether `name` still leads to the segment that is open as `descriptor`."""
    try:
        current = _open_name(name, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return os.path.samestat(os.fstat(current), os.fstat(descriptor))
    finally:
        os.close(current)


def _path(name: str) -> Path:
    """What C opens with shm_open(name)."""
    return SHM / name[1:]


def _open_name(name: str, flags: int) -> int:
    try:
        return os.open(_path(name), flags | os.O_NOFOLLOW, 0o600)
    except PermissionError as error:
        raise LinkError(
            f"the shared memory {name} belongs to another user; choose another --name"
        ) from error

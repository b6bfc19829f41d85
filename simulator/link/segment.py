"""A named POSIX shared memory segment with two roles, server and client; a file lock holds each
role.

The lock of a role is an open-file-description lock on one byte. The kernel releases it when the
process ends, for any reason. Therefore a lock is never stale, unlike a stored pid or a heartbeat.
It also works between containers that share /dev/shm but not their process ids. Only a process that
holds the server's lock may remove the segment.

`multiprocessing.shared_memory` is not used: its resource tracker removes the segment of a running
server when a client of another process tree ends.
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

from simulator.link.errors import LinkError, NameInUse, NoServer
from simulator.link.layout import MAGIC

SHM = Path("/dev/shm")
"""Folder in which Linux stores POSIX shared memory."""
POLL_INTERVAL_S = 0.05
"""Interval at which a waiting process checks that its peer is alive."""
MAX_NAME_BYTES = 250
CLEANUP_TIMEOUT_S = 0.2
FLOCK = "hhqqi4x"  # struct flock: type, whence, start, length, pid


class Role(IntEnum):
    """The role of a process in a segment. Its value is the index of the byte that the role
    locks."""

    SERVER = 0
    CLIENT = 1


@dataclass(eq=False)
class Segment:
    """A mapped segment in which this process has one role."""

    name: str
    role: Role
    descriptor: int
    memory: mmap.mmap

    def bytes(self) -> NDArray[np.uint8]:
        """Return all bytes of the segment; the array shares the memory with the peer."""
        return np.frombuffer(self.memory, dtype=np.uint8)

    def peer_is_alive(self) -> bool:
        """Return whether the peer (the client for a server, the server for a client) is alive."""
        return is_locked(self.descriptor, Role(1 - self.role))

    def publish(self) -> None:
        """Make a new, complete segment visible to clients under its name; replace the segment of a
        dead server.

        Raises NameInUse if a server of this name is running, and LinkError if the name belongs to
        another program or user.
        """
        folder = os.open(SHM, os.O_RDONLY)
        try:
            while True:
                try:
                    # With src_dir_fd, os.link calls linkat, which follows the link in /proc.
                    ours = f"/proc/self/fd/{self.descriptor}"
                    os.link(ours, _path(self.name), src_dir_fd=folder, follow_symlinks=True)
                except FileExistsError:
                    remove_stale(self.name)
                else:
                    return
        finally:
            os.close(folder)

    def close(self) -> None:
        """Release the role; remove the segment if no server is running.

        The memory itself stays mapped as long as arrays view it.
        """
        if self.descriptor >= 0:
            _remove_if_dead(self.name, self.descriptor)
            os.close(self.descriptor)
            self.descriptor = -1


_open: "weakref.WeakSet[Segment]" = weakref.WeakSet()


def _close_in_child() -> None:
    """Close the descriptors in a forked child, because it shares the locks and would keep them."""
    for segment in _open:
        if segment.descriptor >= 0:
            os.close(segment.descriptor)
            segment.descriptor = -1


os.register_at_fork(after_in_child=_close_in_child)


def check_name(name: str) -> str:
    """Return `name`. Raises LinkError unless it is a valid name of shared memory on every system: a
    slash, then at least one character, no further slash, and at most 250 bytes."""
    if not name.startswith("/") or len(name) < 2:
        raise LinkError(f"the link's name is {name!r}; it begins with a slash: /driverview")
    if "/" in name[1:] or "\0" in name or name in ("/.", "/.."):
        raise LinkError(f"the link's name is {name!r}; give one slash and then a plain name")
    if len(os.fsencode(name)) > MAX_NAME_BYTES:
        raise LinkError(
            f"the link's name has {len(os.fsencode(name))} bytes; give at most {MAX_NAME_BYTES}"
        )
    return name


def create(name: str, size: int) -> Segment:
    """Create a segment of `size` bytes, all 0, with the role of the server. It has no name until it
    is published.

    All memory is allocated at once, because a later write to a page without memory would cause a
    bus error. Raises LinkError if there is not enough memory.
    """
    check_name(name)
    descriptor = os.open(SHM, os.O_TMPFILE | os.O_RDWR, 0o600)
    try:
        os.posix_fallocate(descriptor, 0, size)
        try_lock(descriptor, Role.SERVER)
        return _map(name, Role.SERVER, descriptor)
    except OSError as error:
        os.close(descriptor)
        raise LinkError(
            f"there is no room for {size} bytes of shared memory ({error.strerror}); free some in "
            f"{SHM}, enlarge it (docker: --shm-size), or choose a smaller --camera"
        ) from error


def remove_stale(name: str) -> None:
    """Remove the segment of a dead server, if there is one.

    Raises NameInUse if its server is running, and LinkError if the segment belongs to another
    program.
    """
    try:
        descriptor = _open_name(check_name(name), os.O_RDWR)
    except FileNotFoundError:
        return
    try:
        _check_is_link(name, descriptor)
        until = time.monotonic() + CLEANUP_TIMEOUT_S
        while not try_lock(descriptor, Role.SERVER):
            # A client that removes a dead server's segment holds this lock for a moment.
            if time.monotonic() > until:
                raise NameInUse(
                    f"a server of the link {name} is running; end it, or choose another --name"
                )
            time.sleep(CLEANUP_TIMEOUT_S / 20)
        _remove_if_dead(name, descriptor)
    finally:
        os.close(descriptor)


def attach(name: str) -> Segment:
    """Attach to the segment of a running server, with the role of the client.

    Raises NoServer if there is no server (the segment of a dead server is removed), and NameInUse
    if the server has another client.
    """
    check_name(name)
    try:
        descriptor = _open_name(name, os.O_RDWR)
    except FileNotFoundError:
        raise NoServer(
            f"there is no server of the link {name}; start one: simulator link --name {name}"
        ) from None
    try:
        _check_is_link(name, descriptor)
        if not is_locked(descriptor, Role.SERVER):
            _remove_if_dead(name, descriptor)
            raise NoServer(f"the server of {name} has died; start it again")
        if not try_lock(descriptor, Role.CLIENT):
            raise NameInUse(
                f"the server of {name} has a client already, and serves one at a time; end that "
                "one, or start another server under another name"
            )
        return _map(name, Role.CLIENT, descriptor)
    except BaseException:
        os.close(descriptor)
        raise


def _map(name: str, role: Role, descriptor: int) -> Segment:
    # The segment is opened again, because mmap duplicates its descriptor and so keeps its lock.
    mapped = os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR)
    try:
        memory = mmap.mmap(mapped, os.fstat(mapped).st_size)
    finally:
        os.close(mapped)
    segment = Segment(name, role, descriptor, memory)
    _open.add(segment)
    return segment


def _check_is_link(name: str, descriptor: int) -> None:
    """Raises LinkError if the segment belongs to another program."""
    start = os.pread(descriptor, len(MAGIC), 0)
    if start != MAGIC:
        raise LinkError(
            f"the shared memory {name} is no link of this program (it begins with {start!r}); "
            "choose another --name"
        )


def _remove_if_dead(name: str, descriptor: int) -> None:
    """Remove the segment if its server is dead, unless a new server uses the name."""
    if try_lock(descriptor, Role.SERVER) and _is_named(name, descriptor):
        _path(name).unlink()


def is_locked(descriptor: int, role: Role) -> bool:
    """Return whether another process (or another opening of the segment) has `role`."""
    wanted = struct.pack(FLOCK, fcntl.F_WRLCK, os.SEEK_SET, role, 1, 0)
    found = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, wanted)
    return bool(struct.unpack(FLOCK, found)[0] != fcntl.F_UNLCK)


def try_lock(descriptor: int, role: Role) -> bool:
    """Take `role` until the descriptor is closed; returns False if another process has it."""
    wanted = struct.pack(FLOCK, fcntl.F_WRLCK, os.SEEK_SET, role, 1, 0)
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, wanted)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _is_named(name: str, descriptor: int) -> bool:
    """Return whether the segment opened as `descriptor` still has the name `name`."""
    try:
        current = _open_name(name, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return os.path.samestat(os.fstat(current), os.fstat(descriptor))
    finally:
        os.close(current)


def _path(name: str) -> Path:
    """Return the path of the file that shm_open(name) opens in C."""
    return SHM / name[1:]


def _open_name(name: str, flags: int) -> int:
    try:
        return os.open(_path(name), flags | os.O_NOFOLLOW, 0o600)
    except PermissionError as error:
        raise LinkError(
            f"the shared memory {name} belongs to another user; choose another --name"
        ) from error

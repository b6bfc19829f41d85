"""Binds listening sockets of services, and connects to hosts with several addresses.

Commands bind their sockets before they load anything else, to report a port in use at once.
"""

import ctypes
import errno
import socket
import struct
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from trackfeatures.errors import UserError

LOOPBACKS = {socket.AF_INET: "127.0.0.1", socket.AF_INET6: "::1"}
CONNECT_S = 0.25  # least time to connect to one address, unless less time remains in total
MAX_PORT = 65535
PORT_TRIES = 8  # attempts to find one port that is free on every address of a host
# Errors of a machine that lacks IPv4 or IPv6. The addresses of the other protocol are used then.
NO_FAMILY = (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL, errno.EPROTONOSUPPORT)
SO_ATTACH_FILTER = 26  # Linux's value; Python's `socket` lacks it
# Classic BPF on a TCP header: drop (return 0) packets with the SYN flag (0x02 of byte 13).
NO_SYN = ((0x30, 0, 0, 13), (0x45, 0, 1, 2), (0x06, 0, 0, 0), (0x06, 0, 0, 0xFFFFFFFF))

Address = tuple[int, int, int, str, Any]  # a row of `socket.getaddrinfo`


def bind(host: str, port: int) -> socket.socket:
    """Bind a TCP socket to the first address of `host`. Raises UserError if the address is in use,
    unknown or forbidden."""
    try:
        return _bind(_addresses(host, port, socket.AI_PASSIVE)[0])
    except (OSError, UnicodeError) as error:
        raise _cannot_listen(host, port, error) from error


def bind_all(host: str, port: int) -> list[socket.socket]:
    """Bind TCP sockets to the same port of all addresses of `host`; "localhost" has the addresses
    127.0.0.1 and ::1.

    The address `::` also accepts IPv4 connections. An address is left out if this machine lacks
    its protocol, IPv4 or IPv6. Raises UserError if no address remains, or if an address is in use,
    unknown or forbidden.
    """
    for _ in range(PORT_TRIES):
        try:
            return _bind_all(host, port)
        except OSError as error:
            if port or error.errno != errno.EADDRINUSE:
                raise _cannot_listen(host, port, error) from error
        except UnicodeError as error:
            raise _cannot_listen(host, port, error) from error
    raise UserError(
        f"found no port that is free on all addresses of {host}; choose one with --port"
    )


def _bind_all(host: str, port: int) -> list[socket.socket]:
    bound: list[socket.socket] = []
    missing: OSError | None = None
    try:
        for address in _addresses(host, port, socket.AI_PASSIVE):
            try:
                bound.append(_bind(_at_port(address, bound)))
            except OSError as error:
                if error.errno not in NO_FAMILY:
                    raise
                missing = error
        if not bound:
            raise missing or OSError(errno.EADDRNOTAVAIL, "it has no address")
    except BaseException:
        for listener in bound:
            listener.close()
        raise
    return bound


def _at_port(address: Address, bound: list[socket.socket]) -> Address:
    """Return `address` with the port of the first socket in `bound`, or unchanged if `bound` is
    empty."""
    if not bound:
        return address
    *rest, place = address
    return (*rest, (place[0], bound[0].getsockname()[1], *place[2:]))  # type: ignore[return-value]


def _bind(address: Address) -> socket.socket:
    family, kind, protocol, _, place = address
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            only = place[0] != "::"
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, only)
        listener.bind(place)
        listener.set_inheritable(True)
    except BaseException:
        listener.close()
        raise
    return listener


def _addresses(host: str, port: int, flags: int = 0) -> list[Address]:
    """Return the TCP addresses of `host`, without duplicates. Raises OSError for a port above
    65535 or below 0, of which `getaddrinfo` would use the last 16 bits.

    For "localhost" the result always contains both loopback addresses (RFC 6761, 6.3), also if one
    of them is missing in /etc/hosts.
    """
    if not 0 <= port <= MAX_PORT:
        raise OSError(errno.EINVAL, f"ports are 0 to {MAX_PORT}")
    hosts = [host]
    if is_localhost(host):
        hosts += LOOPBACKS.values()
    found: dict[Any, Address] = {}
    for name in hosts:
        try:
            for address in socket.getaddrinfo(name, port, type=socket.SOCK_STREAM, flags=flags):
                found.setdefault(address[4], address)
        except OSError:
            if name == host and len(hosts) == 1:
                raise
    return list(found.values())


def is_localhost(host: str) -> bool:
    """Whether the name `host` stands for the loopback addresses: "localhost" or a name that ends in
    ".localhost"."""
    name = host.lower().removesuffix(".")
    return name == "localhost" or name.endswith(".localhost")


def connect(
    place: tuple[str, int], timeout_s: float | None, source: tuple[str, int] | None = None
) -> socket.socket:
    """Connect to the first address of `place` (host, port) that accepts the connection; all
    attempts together take at most `timeout_s`. `source` is the local address (host, port), None
    for any.

    Each address gets an equal share of the remaining time, but at least 0.25 s (CONNECT_S), unless
    less time remains. If all addresses fail, the first OSError is raised that does not report a
    missing IPv4 or IPv6; if there is none, the first OSError is raised. The arguments are the
    arguments of `socket.create_connection`.
    """
    host, port = place
    addresses = _addresses(host, port)
    end_s = None if timeout_s is None else time.monotonic() + timeout_s
    errors: list[OSError] = []
    for number, (family, kind, protocol, _, at) in enumerate(addresses):
        try:
            connection = socket.socket(family, kind, protocol)
        except OSError as error:
            errors.append(error)
            continue
        try:
            if end_s is not None:
                left_s = max(0.001, end_s - time.monotonic())
                share_s = left_s / (len(addresses) - number)
                connection.settimeout(max(share_s, min(left_s, CONNECT_S)))
            if source is not None:
                connection.bind(source)
            connection.connect(at)
            connection.settimeout(timeout_s)
        except OSError as error:
            connection.close()
            errors.append(error)
        else:
            return connection
    raise min(errors, key=lambda error: error.errno in NO_FAMILY)


def refuse_connections(listener: socket.socket) -> None:
    """Refuse new connections to a listening socket; connections in its queue can still be accepted.

    Closing a listening socket resets the connections in its queue, and a connection could always
    arrive between the last accept and the close. Therefore, after this call the kernel drops SYN
    packets. A client sends its SYN packet again after 1 s, and is refused once the socket is
    closed. This function does nothing on systems without socket filters; Linux has socket filters.
    """
    program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in NO_SYN))
    head = struct.pack("HP", len(NO_SYN), ctypes.addressof(program))
    with suppress(OSError):
        listener.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, head)


def address(listener: socket.socket, host: str) -> str:
    """Return the URL of the service at `host` that listens on the bound socket `listener`. The URL
    contains the actual port, which the system chose if port 0 was requested."""
    return url(host, listener.getsockname()[1])


def url(host: str, port: int) -> str:
    """Return the URL of a service; the zone of an IPv6 address is escaped as in RFC 6874."""
    shown = f"[{host.replace('%', '%25')}]" if ":" in host else host
    return f"http://{shown}:{port}"


def shown_addresses(listeners: Iterable[socket.socket]) -> str:
    """Return the addresses of bound sockets as text, such as "127.0.0.1 and ::1"."""
    return " and ".join(str(listener.getsockname()[0]) for listener in listeners)


def _cannot_listen(host: str, port: int, error: OSError | UnicodeError) -> UserError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return UserError(
        f"cannot listen on {host} port {port}: {reason}; choose another with --host or --port "
        "(--port 0 takes any free one)"
    )

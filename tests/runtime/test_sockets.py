"""Listening sockets and connections: ports in use, unknown hosts, IPv4 and IPv6, URLs."""

import errno
import socket
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from runtime import sockets
from runtime.sockets import address, bind, bind_all, connect, refuse_connections, url
from trackfeatures import UserError


def test_port_0_takes_a_free_port_that_the_url_names() -> None:
    with bind("127.0.0.1", 0) as listener:
        assert address(listener, "127.0.0.1") == f"http://127.0.0.1:{listener.getsockname()[1]}"
        assert address(listener, "::1").startswith("http://[::1]:")


def test_an_invalid_host_is_refused() -> None:
    with pytest.raises(UserError, match="cannot listen on"):
        bind("a..b", 8000)


@pytest.mark.parametrize("port", [-1, 65536, 70000])
def test_a_port_out_of_range_is_refused(port: int) -> None:
    for listen in (bind, bind_all):
        with pytest.raises(UserError, match=rf"port {port}: ports are 0 to 65535"):
            listen("127.0.0.1", port)
    for host in ("127.0.0.1", "localhost"):
        with pytest.raises(OSError, match="ports are 0 to 65535"):
            connect((host, port), 5)


def test_a_refused_address_leaves_no_socket_open() -> None:
    with bind("127.0.0.1", 0) as listener:
        listener.listen()
        before = open_descriptors()
        with pytest.raises(UserError, match="choose another with --host or --port") as caught:
            bind("127.0.0.1", listener.getsockname()[1])
        assert open_descriptors() == before, caught  # `caught` keeps the traceback's frames alive


def open_descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


FAMILIES = {"127.0.0.1": socket.AF_INET, "::1": socket.AF_INET6}
without_family = pytest.mark.skipif(not socket.has_ipv6, reason="this kernel has no IPv6")


def families_of(listeners: list[socket.socket]) -> set[int]:
    return {listener.family for listener in listeners}


@without_family
@pytest.mark.parametrize("host", ["localhost", "LocalHost", "localhost.", "x.localhost"])
def test_localhost_listens_on_both_loopback_addresses(host: str) -> None:
    listeners = bind_all(host, 0)
    with ExitStack() as stack:
        for listener in listeners:
            stack.enter_context(listener).listen()
        assert families_of(listeners) == set(FAMILIES.values())
        (port,) = {listener.getsockname()[1] for listener in listeners}
        for name in FAMILIES:
            socket.create_connection((name, port), 5).close()
        for taken in ("127.0.0.1", "::1", "localhost"):
            with pytest.raises(UserError, match="in use"):
                bind_all(taken, port)


@without_family
def test_the_unspecified_ipv6_address_takes_both_families() -> None:
    with ExitStack() as stack:
        (listener,) = bind_all("::", 0)
        stack.enter_context(listener).listen()
        clients = []
        for name in FAMILIES:
            socket.create_connection((name, listener.getsockname()[1]), 5).close()
            connection, address = listener.accept()
            connection.close()
            clients.append(address[0])
        assert sorted(clients) == ["::1", "::ffff:127.0.0.1"]


@pytest.mark.parametrize("missing", FAMILIES.values())
@pytest.mark.parametrize("code", [errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL])
def test_a_family_that_the_kernel_lacks_is_left_out(
    monkeypatch: pytest.MonkeyPatch, missing: int, code: int
) -> None:
    real = socket.socket

    def make(family: int = -1, *arguments: Any, **named: Any) -> socket.socket:
        if family == missing:
            raise OSError(code, "Address family not supported by protocol")
        return real(family, *arguments, **named)

    monkeypatch.setattr(socket, "socket", make)
    (listener,) = bind_all("localhost", 0)
    with listener:
        listener.listen()
        assert listener.family != missing
        connect(("localhost", listener.getsockname()[1]), 5).close()
    with pytest.raises(UserError, match="cannot listen on"):
        bind_all(next(name for name, family in FAMILIES.items() if family == missing), 0)


@without_family
@pytest.mark.parametrize("listens", FAMILIES)
def test_a_connection_tries_all_addresses(listens: str) -> None:
    with bind(listens, 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(ConnectionRefusedError):
            connect(("localhost", port), 5)
        listener.listen()
        for host in ("localhost", "LOCALHOST", listens):
            with connect((host, port), 5) as connection:
                assert connection.gettimeout() == 5
                assert connection.family == FAMILIES[listens]
        other = next(name for name in FAMILIES if name != listens)
        with pytest.raises(ConnectionRefusedError):  # a literal address has no alternative
            connect((other, port), 5)


@pytest.mark.alone
def test_addresses_that_do_not_answer_share_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with bind("127.0.0.1", 0) as listener:
        listener.listen(0)
        place = listener.getsockname()
        full = [socket.socket() for _ in range(2)]
        for one in full:  # they fill the queue: the kernel then drops further SYNs
            one.setblocking(False)
            one.connect_ex(place)
        found = (socket.AF_INET, socket.SOCK_STREAM, 0, "", place)
        monkeypatch.setattr(sockets, "_addresses", lambda *_: [found] * 3)
        start = time.monotonic()
        with pytest.raises(TimeoutError):
            connect(("somewhere", place[1]), 0.6)
        assert time.monotonic() - start < 1.5
        for one in full:
            one.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_after_the_last_connection_none_begins_and_none_is_reset(host: str) -> None:
    with bind(host, 0) as listener:
        listener.listen(8)
        place = listener.getsockname()[:2]
        waiting = socket.create_connection(place, 5)
        refuse_connections(listener)
        with pytest.raises(TimeoutError):
            socket.create_connection(place, 0.2)
        accepted, _ = listener.accept()
        accepted.sendall(b"last")
        assert waiting.recv(4) == b"last"
        waiting.close()
        accepted.close()


def test_urls_of_ipv6_have_brackets_and_an_escaped_zone() -> None:
    assert url("::1", 80) == "http://[::1]:80"
    assert url("fe80::1%eth0", 80) == "http://[fe80::1%25eth0]:80"

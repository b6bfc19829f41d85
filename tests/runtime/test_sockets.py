"""Listening sockets: free ports, ports in use, unknown hosts, URLs."""

from pathlib import Path

import pytest

from runtime.sockets import address, bind
from trackfeatures import UserError


def test_port_0_takes_a_free_port_that_the_url_names() -> None:
    with bind("127.0.0.1", 0) as listener:
        assert address(listener, "127.0.0.1") == f"http://127.0.0.1:{listener.getsockname()[1]}"
        assert address(listener, "::1").startswith("http://[::1]:")


def test_a_port_in_use_is_refused() -> None:
    with bind("127.0.0.1", 0) as listener:
        listener.listen()
        with pytest.raises(UserError, match="choose another with --host or --port"):
            bind("127.0.0.1", listener.getsockname()[1])


def test_an_invalid_host_is_refused() -> None:
    with pytest.raises(UserError, match="cannot listen on"):
        bind("a..b", 8000)


def test_a_refused_address_leaves_no_socket_open() -> None:
    with bind("127.0.0.1", 0) as listener:
        listener.listen()
        before = open_descriptors()
        with pytest.raises(UserError) as caught:
            bind("127.0.0.1", listener.getsockname()[1])
        assert open_descriptors() == before, caught  # which would hold the socket


def open_descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))

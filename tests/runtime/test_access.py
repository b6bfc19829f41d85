"""Host names and tokens that a service accepts; tests/serve/attacks/test_hosts.py tests them over
HTTP."""

from pathlib import Path

import pytest

from runtime.access import host_name, is_loopback, read_token
from trackfeatures.errors import UserError


def test_loopback_addresses() -> None:
    assert all(map(is_loopback, ["127.0.0.1", "127.8.8.8", "::1", "localhost", "::ffff:127.0.0.1"]))
    assert not any(
        map(is_loopback, ["0.0.0.0", "::", "10.0.0.1", "example.org", "", "::ffff:1.2.3.4"])
    )


def test_names_of_hosts() -> None:
    found = {host: host_name(host) for host in (b"A:1", b"[::1]:2", b"::1", b"a.", b"10.0.0.1")}
    assert list(found.values()) == ["a", "::1", "::1", "a", "10.0.0.1"]
    for host in (b"", b":80", b"a:b", b"[::1", b"[::1]x", b"a:\xb2"):
        assert host_name(host) is None


def test_a_token_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "token").write_bytes(b"\xff" * 32)
    with pytest.raises(UserError, match="printable ASCII"):
        read_token(tmp_path / "token")

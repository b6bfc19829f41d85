"""Serialises the head of a request with an upgrade again, to feed it to another parser."""

from collections.abc import Iterable

UPGRADE_HEADERS = frozenset({b"upgrade", b"http2-settings"})


def repeat_head(
    method: bytes,
    url: bytes,
    version: str,
    headers: Iterable[tuple[bytes, bytes]],
    ignore: frozenset[bytes] = frozenset(),
) -> bytes:
    """The bytes of a request's head without the headers in `ignore` (lower case), which are also
    removed from the value of `Connection`."""
    lines = [b"%b %b HTTP/%b\r\n" % (method, url, version.encode())]
    for name, value in headers:
        if name == b"connection" and ignore:
            options = [option.strip() for option in value.split(b",")]
            value = b", ".join(o for o in options if o.lower() not in ignore)
        if name not in ignore:
            lines.append(b"%b: %b\r\n" % (name, value))
    return b"".join(lines) + b"\r\n"

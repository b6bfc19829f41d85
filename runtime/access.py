"""Access control of a service: its token, the addresses it listens on, and the accepted values of
the Host and Origin headers.

A web page can make its own host name resolve to this machine (DNS rebinding), or send a "simple"
cross-origin POST. Without a token only these two headers distinguish a foreign page from a client
that the user started. Source: RFC 9112, 3.2 (Host); RFC 6454 (Origin).
"""

import os
from collections.abc import Iterable
from ipaddress import ip_address
from pathlib import Path

from trackfeatures.errors import UserError

TOKEN_VARIABLE = "DRIVERVIEW_TOKEN"
MIN_TOKEN_LENGTH = 16


def read_token(path: Path | None) -> str | None:
    """Read the token from the file `path`, or from $DRIVERVIEW_TOKEN if `path` is None; return None
    if the variable is unset or empty.

    Raises UserError if the file is missing or empty, or if the token is shorter than 16 characters
    or has a space or a character that is not printable ASCII.
    """
    if path is None:
        token = os.environ.get(TOKEN_VARIABLE, "").strip()
        source = f"${TOKEN_VARIABLE}"
    elif path.is_file():
        token, source = path.read_text(encoding="utf-8", errors="replace").strip(), str(path)
    else:
        raise UserError(f"there is no token file {path}; create one with `openssl rand -hex 32`")
    if not token:
        if path is not None:
            raise UserError(f"{source} is empty; `openssl rand -hex 32` creates a token")
        return None
    printable = token.isascii() and token.isprintable() and " " not in token
    if len(token) < MIN_TOKEN_LENGTH or not printable:
        raise UserError(
            f"the token in {source} must be {MIN_TOKEN_LENGTH} or more printable ASCII characters "
            "without a space; `openssl rand -hex 32` creates one"
        )
    return token


def check_exposure(host: str, token: str | None, insecure: bool) -> None:
    """Raise UserError if other machines can reach `host` and there is no token, unless `insecure`
    allows it."""
    if is_loopback(host) or token is not None or insecure:
        return
    raise UserError(
        f"--host {host} can be reached from other machines: set a token (--token-file, or "
        f"{TOKEN_VARIABLE} in the environment), or pass --insecure if a proxy protects the service"
    )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach `host`: a loopback address or the name "localhost"."""
    try:
        found = ip_address(host.partition("%")[0])
    except ValueError:
        return host.lower().removesuffix(".") == "localhost"
    mapped = getattr(found, "ipv4_mapped", None)
    return (mapped or found).is_loopback


class HostNames:
    """The host names that a service accepts in the headers Host and Origin of a request."""

    def __init__(self, names: Iterable[str], *, any_name: bool) -> None:
        """Accept `names` in addition to the loopback names and addresses. With `any_name` every
        Host is accepted; use it only for a service that requires a token from each client."""
        found = (host_name(name.encode("latin-1", "replace")) for name in names)
        self._names = {name for name in found if name is not None}
        self._any_name = any_name
        # A service that listens on all addresses accepts every address. A page that uses DNS
        # rebinding sends a name, not an address.
        self._any_address = any(_is_unspecified(name) for name in self._names)

    def allow_host(self, host: bytes) -> bool:
        """Whether a request with this Host header is accepted."""
        if self._any_name:
            return True
        name = host_name(host)
        if name is None:
            return False
        return is_loopback(name) or name in self._names or (self._any_address and _is_ip(name))

    def allow_origin(self, origin: bytes, host: bytes) -> bool:
        """Whether a request with this Origin is accepted. `origin` must be the service's own origin
        (its host and port equal the header `host`), or contain one of the names given to this
        object, because a proxy can change the header Host.

        All other origins are refused: a page of another site could send requests through the
        browser of a user who can reach this service.
        """
        scheme, separator, place = origin.lower().partition(b"://")
        if not (separator and scheme in (b"http", b"https") and place):
            return False
        if place == host.lower():
            return True
        name = host_name(place)
        return name is not None and name in self._names and not _is_unspecified(name)


def host_name(host: bytes) -> str | None:
    """Return the name in a Host header (`name` or `name:port`), in lower case; None if the header
    is malformed.

    An IPv6 address is returned in its shortest form, without brackets and without its zone, because
    a zone has a meaning on one machine only.
    """
    text = host.decode("latin-1").lower()
    name, port = text, ""
    if text.startswith("["):
        name, bracket, port = text[1:].partition("]")
        if not bracket or (port and not port.startswith(":")):
            return None
        port = port[1:]
    elif text.count(":") <= 1:
        name, _, port = text.partition(":")
    if not name or (port and not (port.isascii() and port.isdigit())):
        return None
    if ":" in name:
        address = name.partition("%")[0]
        return str(ip_address(address)) if _is_ip(address) else None
    return name.removesuffix(".")


def _is_ip(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _is_unspecified(name: str) -> bool:
    return _is_ip(name) and ip_address(name).is_unspecified

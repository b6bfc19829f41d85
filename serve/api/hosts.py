"""Which names a request may call this service by, and from which pages it may come.

A web page can point a name of its own at this machine (DNS rebinding), or post to it without asking
(a "simple" request). Without a token nothing else tells such a page from a client of the user's.
Source: RFC 9112, 3.2 (Host); RFC 6454 (Origin).
"""

from ipaddress import ip_address

from serve.api.problems import FORBIDDEN_HOST, FORBIDDEN_ORIGIN, MALFORMED, Problem
from serve.api.request_options import Headers
from serve.config import Limits, is_loopback

MAX_KNOWN = 256  # pairs of Host and Origin that were accepted before
HTTP_1_0 = "1.0"


class HostCheck:
    """Checks the Host and the Origin of every request."""

    def __init__(self, limits: Limits) -> None:
        found = (host_name(name.encode("latin-1", "replace")) for name in limits.hosts)
        self._names = names = {name for name in found if name is not None}
        self._any_name = limits.token is not None
        # A service that listens on all addresses is called by any of them: a rebound name is none.
        self._any_address = any(_is_unspecified(name) for name in names)
        self._known: set[tuple[bytes | None, bytes | None]] = set()

    def check(self, headers: Headers, *, probe: bool = False, version: str = "1.1") -> None:
        """Raise Problem unless the request may use the service.

        `probe`: any Host will do, as probes come by the address of a pod.
        """
        host, origin = headers.get(b"host"), headers.get(b"origin")
        if host is None and (version != HTTP_1_0 or not self._any_name):
            raise Problem(MALFORMED, "the request has no Host header; send one")
        if (host, origin) in self._known:
            return
        if not (probe or self._any_name or self._allows(host or b"")):
            raise Problem(
                FORBIDDEN_HOST,
                f"the Host is {_shown(host or b'')}, which this service does not answer to without "
                "a token; use its address, or start it with --allow-host or a token",
            )
        if origin is not None:
            self._check_origin(origin, host or b"")
        if not probe and len(self._known) < MAX_KNOWN:
            self._known.add((host, origin))

    def check_single(self, names: list[bytes]) -> None:
        """Raise Problem when the names of a request's headers hold Host twice."""
        if names.count(b"host") > 1:
            raise Problem(MALFORMED, "the request has more than one Host header; send one")

    def _allows(self, host: bytes) -> bool:
        name = host_name(host)
        if name is None:
            return False
        return is_loopback(name) or name in self._names or (self._any_address and _is_ip(name))

    def _check_origin(self, origin: bytes, host: bytes) -> None:
        """Raise Problem for a page of another site: it could use the browser of a user in here."""
        scheme, separator, place = origin.lower().partition(b"://")
        if separator and scheme in (b"http", b"https") and place:
            if place == host.lower():
                return
            name = host_name(place)
            if name is not None and name in self._names and not _is_unspecified(name):
                return  # a proxy has changed the Host
        raise Problem(FORBIDDEN_ORIGIN, f"the page's origin is {_shown(origin)}, not this service")


def host_name(host: bytes) -> str | None:
    """The name in `name:port`, in lower case; None if malformed.

    Of IPv6 the shortest form of the address, without brackets and without a zone, which has a
    meaning on one machine only.
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


def _shown(value: bytes) -> str:
    return repr(value[:80].decode("latin-1"))

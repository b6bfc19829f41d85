"""Refuses requests with a foreign Host or Origin header, with a problem; `runtime.access` gives the
reason."""

from runtime.access import HostNames
from runtime.access import host_name as host_name
from serve.api.problems import FORBIDDEN_HOST, FORBIDDEN_ORIGIN, MALFORMED, Problem
from serve.api.request_options import Headers
from serve.config import Limits

MAX_KNOWN = 256  # number of accepted pairs of Host and Origin in the cache
HTTP_1_0 = "1.0"


class HostCheck:
    """Checks the Host and the Origin of every request."""

    def __init__(self, limits: Limits) -> None:
        self._any_name = limits.token is not None
        self._names = HostNames(limits.hosts, any_name=self._any_name)
        self._known: set[tuple[bytes | None, bytes | None]] = set()

    def check(self, headers: Headers, *, probe: bool = False, version: str = "1.1") -> None:
        """Raise Problem if the Host or the Origin is not accepted.

        With `probe` any Host is accepted: probes use the address of a pod.
        """
        host, origin = headers.get(b"host"), headers.get(b"origin")
        if host is None and (version != HTTP_1_0 or not self._any_name):
            raise Problem(MALFORMED, "the request has no Host header; send one")
        if (host, origin) in self._known:
            return
        if not (probe or self._names.allow_host(host or b"")):
            raise Problem(
                FORBIDDEN_HOST,
                f"the Host is {_shown(host or b'')}, which this service does not accept without a "
                "token; use its address, or start it with --allow-host or a token",
            )
        if origin is not None and not self._names.allow_origin(origin, host or b""):
            raise Problem(
                FORBIDDEN_ORIGIN, f"the page's origin is {_shown(origin)}, not this service's"
            )
        if not probe and len(self._known) < MAX_KNOWN:
            self._known.add((host, origin))

    def check_single(self, names: list[bytes]) -> None:
        """Raise Problem if the header names of a request contain Host twice."""
        if names.count(b"host") > 1:
            raise Problem(MALFORMED, "the request has more than one Host header; send one")


def _shown(value: bytes) -> str:
    return repr(value[:80].decode("latin-1"))

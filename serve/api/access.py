"""Refuses requests by their headers: rate of the client, Host and Origin, token.

`runtime.access` gives the reason for the checks of Host and Origin.
"""

from collections.abc import Callable
from hmac import compare_digest

from runtime.access import HostNames
from serve.api import kserve
from serve.api.console import DOCS_PATH
from serve.api.request_options import Headers, request_id_of
from serve.asgi import Scope, client_address
from serve.config import Limits
from serve.problems import FORBIDDEN_HOST, FORBIDDEN_ORIGIN, MALFORMED, UNAUTHORIZED, Problem
from serve.replies import Reply, problem_reply
from serve.scheduling.rate_limit import RateLimiter

PROBES = {"/healthz", "/readyz", *kserve.PROBES}  # load balancers need no token for these
MAX_KNOWN = 256  # number of accepted pairs of Host and Origin in the cache
HTTP_1_0 = "1.0"


class Access:
    """Checks every request before the service does any other work for it."""

    def __init__(
        self,
        limits: Limits,
        rate_limiter: RateLimiter,
        count_refusal: Callable[[Problem, str, str], None],
    ) -> None:
        """`count_refusal` is called with the problem, the request's id and the client's address."""
        self._rate_limiter = rate_limiter
        self._hosts = HostCheck(limits)
        self._token = limits.token
        self._count_refusal = count_refusal

    def refusal(self, headers: Headers, client: str) -> Reply | None:
        """Return the reply that refuses a request POST /features; None if the request is accepted.

        The caller must have refused a request in which a header name occurs twice.
        """
        try:
            self._rate_limiter.check(client)
            self._hosts.check(headers)
            self._check_token(headers)
        except Problem as problem:
            return self._refuse(problem, headers, client)
        return None

    def scope_refusal(self, scope: Scope) -> Reply | None:
        """Return the reply that refuses a request for any path, from its ASGI scope; None if the
        request is accepted. A header name can occur twice."""
        path, headers, client = scope["path"], dict(scope["headers"]), client_address(scope)
        try:
            public = _is_public(path)
            self._rate_limiter.check(client, public=public)
            self._hosts.check_single([name for name, _ in scope["headers"]])
            version = scope.get("http_version", "1.1")
            self._hosts.check(headers, probe=path in PROBES, version=version)
            if not public:
                self._check_token(headers)
        except Problem as problem:
            return self._refuse(problem, headers, client, path)
        return None

    def _check_token(self, headers: Headers) -> None:
        if self._token is None:
            return
        scheme, _, sent = headers.get(b"authorization", b"").partition(b" ")
        if scheme.lower() != b"bearer" or not compare_digest(sent.strip(), self._token.encode()):
            raise Problem(
                UNAUTHORIZED, "send the service's token with the header Authorization: Bearer TOKEN"
            )

    def _refuse(self, problem: Problem, headers: Headers, client: str, path: str = "") -> Reply:
        request_id = request_id_of(headers)
        self._count_refusal(problem, request_id, client)
        return problem_reply(problem, (b"x-request-id", request_id.encode()), path=path)


class HostCheck:
    """Checks the Host and the Origin of every request."""

    def __init__(self, limits: Limits) -> None:
        self._any_name = limits.token is not None
        self._names = HostNames(limits.hosts, any_name=self._any_name)
        self._known: set[tuple[bytes | None, bytes | None]] = set()

    def check(self, headers: Headers, *, probe: bool = False, version: str = "1.1") -> None:
        """Raise Problem if the Host or the Origin is not accepted.

        With `probe`, for the paths of health checks, any Host is accepted, because a load balancer
        sends the address of the container. A request of HTTP `version` 1.0 needs no Host if the
        service has a token.
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


def _is_public(path: str) -> bool:
    """Whether a path needs no token: probes, docs, and the console, which asks for the token."""
    return path in PROBES or path in ("/", DOCS_PATH) or path.startswith("/console/")

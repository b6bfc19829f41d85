"""How much the service takes from its clients, and how long it waits for them."""

from dataclasses import dataclass
from ipaddress import ip_address

MAX_BODY_BYTES = 4 << 20
MAX_HEAD_BYTES = 32 << 10
MAX_NAME = 128  # characters of a frame's, a request's or a stream's name
MAX_DEADLINE_MS = 60_000  # the longest a client may give
TOKEN_VARIABLE = "DRIVERVIEW_TOKEN"


@dataclass(frozen=True)
class Limits:
    """What may be changed without a change of the program; the defaults are those of the README."""

    connections: int = 256
    """Open connections of all workers together."""
    queue: int = 4
    """Frames a worker lets wait while it answers one."""
    head_s: float = 5.0
    """Within which the headers of a request must be there."""
    body_s: float = 10.0
    """Within which its body must be there, from its headers on."""
    idle_s: float = 30.0
    """For which a connection may stay open with no request in it."""
    rate: float = 200.0
    """Requests a second of one client address, in bursts of as many; 0: any number."""
    log_answers: bool = False
    """Whether answered requests stand in the log, not only refused ones."""
    token: str | None = None
    """What `Authorization: Bearer` must hold; None: nothing is asked."""


def is_loopback(host: str) -> bool:
    """Whether an address, or the name "localhost", means this machine alone."""
    try:
        found = ip_address(host.partition("%")[0])
    except ValueError:
        return host == "localhost"
    mapped = getattr(found, "ipv4_mapped", None)
    return (mapped or found).is_loopback

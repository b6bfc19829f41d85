"""Configuration of the service: limits for clients, the token, and the address to listen on."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import IPv6Address, ip_address, ip_network

from trackfeatures.errors import UserError

MAX_BODY_BYTES = 4 << 20
MAX_HEAD_BYTES = 32 << 10
MAX_NAME = 128  # characters of a frame id, a request id or a stream id
MAX_DEADLINE_MS = 60_000  # the longest deadline that a client may set
MAPPED_BITS = 96  # length of ::ffff:, the prefix of IPv4-mapped IPv6 addresses


@dataclass(frozen=True)
class Limits:
    """Limits for clients. `docs/how-to/deploy.md` documents these defaults."""

    connections: int = 256
    """Largest number of open connections of all workers together."""
    queue: int = 4
    """Largest number of frames that wait in one worker while it processes a frame."""
    head_s: float = 5.0
    """Longest time to receive the headers of a request."""
    body_s: float = 10.0
    """Longest time to receive the body of a request, from the end of its headers."""
    idle_s: float = 30.0
    """Longest time that a connection stays open without a request."""
    rate: float = 200.0
    """Requests per second from one client address, also the size of a burst; 0: no limit."""
    log_answers: bool = False
    """Log every answered request. Refused requests are always logged."""
    token: str | None = None
    """Token that requests must have in `Authorization: Bearer`; None: no token is required."""
    hosts: tuple[str, ...] = ()
    """Accepted names in the Host header besides the loopback names; ignored with a token."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses and networks of proxies whose X-Forwarded-For is used; empty: 127.0.0.1."""
    body_mib: int = 64
    """Memory in MiB for the bodies of all unanswered requests of all workers."""


@dataclass(frozen=True)
class ServiceConfig:
    """Options of the command `serve`."""

    model: str = "default"
    """A run's folder, its name in runs/, "latest", or the name of a model that ships."""
    host: str = "127.0.0.1"
    port: int = 8000
    """Port to listen on; 0 stands for any free port, which the first line on stderr shows."""
    workers: int = 1
    insecure: bool = False
    """Allow a `host` that other machines can reach although there is no token."""
    limits: Limits = field(default_factory=Limits)
    cameras: tuple[str, ...] = ()
    """NAME=FILE of each camera that requests can name."""
    views: int = 1
    """Number of views of each image whose answers are averaged: 1, 2 or 6."""
    threads: int | None = None
    """Number of threads with which each worker computes an answer; None: `default_threads`."""


def check_proxies(proxies: Iterable[str]) -> tuple[str, ...]:
    """Return the values of `--trusted-proxy`; an IPv4-mapped IPv6 network (::ffff:10.0.0.1) is
    returned as an IPv4 network. Raises UserError if a value is neither an IP address nor a
    network."""
    found = []
    for proxy in proxies:
        try:
            network = ip_network(proxy)
            mapped = getattr(network.network_address, "ipv4_mapped", None)
            is_ipv4 = mapped is not None and network.prefixlen >= MAPPED_BITS
            found.append(f"{mapped}/{network.prefixlen - MAPPED_BITS}" if is_ipv4 else proxy)
        except ValueError as error:
            raise UserError(
                f"--trusted-proxy is {proxy!r} ({error}); give an address or a network, for "
                "example 10.0.0.7 or 10.0.0.0/8"
            ) from error
    return tuple(found)


def ipv4_mapped(proxies: Iterable[str]) -> list[str]:
    """Return the IPv4-mapped IPv6 network of each IPv4 address or network in `proxies`. A proxy
    writes this form of an address to X-Forwarded-For if its own socket accepts IPv4 and IPv6."""
    networks = [found for found in map(ip_network, proxies) if found.version == 4]
    return [f"::ffff:{n.network_address}/{MAPPED_BITS + n.prefixlen}" for n in networks]


@lru_cache(4096)
def network_of(address: str) -> str:
    """Return the network of a client: its IPv4 address itself (also of an IPv4-mapped IPv6
    address), or the /64 network of another IPv6 address, since a client usually owns a /64."""
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if not isinstance(found, IPv6Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return f"{found.packed[:8].hex()}/64"

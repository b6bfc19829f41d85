"""Configuration of the service: limits on its clients, the token, and the address to listen on."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import IPv6Address, ip_address, ip_network
from pathlib import Path

from trackfeatures.errors import UserError

MAX_BODY_BYTES = 4 << 20
MAX_HEAD_BYTES = 32 << 10
MAX_NAME = 128  # characters of a frame id, a request id or a stream id
MAX_DEADLINE_MS = 60_000  # the longest deadline that a client may set
TOKEN_VARIABLE = "DRIVERVIEW_TOKEN"
MIN_TOKEN_LENGTH = 16


@dataclass(frozen=True)
class Limits:
    """Limits on clients. `docs/how-to/deploy.md` documents these defaults."""

    connections: int = 256
    """Open connections of all workers together."""
    queue: int = 4
    """Frames that may wait in one worker while it processes another."""
    head_s: float = 5.0
    """Time to receive the headers of a request."""
    body_s: float = 10.0
    """Time to receive the body of a request, counted from the end of its headers."""
    idle_s: float = 30.0
    """Time a connection may stay open without a request."""
    rate: float = 200.0
    """Requests a second from one client address, and the size of a burst; 0: no limit."""
    log_answers: bool = False
    """Log every answered request. Refused requests are always logged."""
    token: str | None = None
    """Required in `Authorization: Bearer`; None: no token is required."""
    hosts: tuple[str, ...] = ()
    """Names beside the loopback ones that a Host header may have without a token."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses and networks whose X-Forwarded-For is believed; empty: 127.0.0.1."""
    body_mib: int = 64
    """Memory for the bodies of all requests in flight, MiB."""


@dataclass(frozen=True)
class ServiceConfig:
    """Options of the command `serve`."""

    model: str = "default"
    """A run's folder, its name in runs/, "latest" or "default"."""
    host: str = "127.0.0.1"
    port: int = 8000
    """0: any free port; the first line on stderr names it."""
    workers: int = 1
    insecure: bool = False
    """Listen on addresses that other machines can reach, without a token."""
    limits: Limits = field(default_factory=Limits)
    cameras: tuple[str, ...] = ()
    """NAME=FILE of each camera that requests may name."""


def read_token(path: Path | None) -> str | None:
    """The token in a file, else in $DRIVERVIEW_TOKEN, else None. Raises UserError."""
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
    """Raise UserError when other machines could use the service without a token."""
    if is_loopback(host) or token is not None or insecure:
        return
    raise UserError(
        f"--host {host} can be reached from other machines: set a token (--token-file, or "
        f"{TOKEN_VARIABLE} in the environment), or pass --insecure if a proxy protects the service"
    )


def check_proxies(proxies: Iterable[str]) -> tuple[str, ...]:
    """The addresses and networks of `--trusted-proxy`. Raises UserError for anything else."""
    found = tuple(proxies)
    for proxy in found:
        try:
            ip_network(proxy)
        except ValueError as error:
            raise UserError(
                f"--trusted-proxy is {proxy!r} ({error}); give an address or a network, as "
                "10.0.0.7 or 10.0.0.0/8"
            ) from error
    return found


def is_loopback(host: str) -> bool:
    """Whether an address, or the name "localhost", can be reached from this machine only."""
    try:
        found = ip_address(host.partition("%")[0])
    except ValueError:
        return host.lower().removesuffix(".") == "localhost"
    mapped = getattr(found, "ipv4_mapped", None)
    return (mapped or found).is_loopback


@lru_cache(4096)
def network_of(address: str) -> str:
    """The address, or the /64 network of an IPv6 address; an IPv4 address within IPv6 is that."""
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if not isinstance(found, IPv6Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return f"{found.packed[:8].hex()}/64"

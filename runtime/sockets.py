"""Listening sockets of the commands that serve.

A socket is bound before anything else is loaded, so that a port in use is reported at once.
"""

import socket

from trackfeatures.errors import UserError


def bind(host: str, port: int) -> socket.socket:
    """A bound TCP socket. Raises UserError when the address is taken, unknown or forbidden."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
        except OSError:
            listener.close()
            raise
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError(
            f"cannot listen on {host} port {port}: {reason}; choose another with --host or --port "
            "(--port 0 takes any free one)"
        ) from error
    listener.set_inheritable(True)
    return listener


def address(listener: socket.socket, host: str) -> str:
    """The URL of a bound socket, with the port that the system chose for port 0."""
    shown = f"[{host}]" if ":" in host else host
    return f"http://{shown}:{listener.getsockname()[1]}"

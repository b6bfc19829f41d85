"""Exceptions of the link; each message says what to do."""

from trackfeatures.errors import UserError


class LinkError(UserError):
    """The link cannot be opened, or is lost."""


class NoServer(LinkError):
    """There is no server of that name (yet)."""


class NameInUse(LinkError):
    """Another process holds this name, or this role on the link."""


class LayoutMismatch(LinkError):
    """Server and client use different layouts of the memory."""


class ServerDied(LinkError):
    """The server's process is gone, or it has closed the link."""


class ClientLost(LinkError):
    """The server's client has died, or has sent nothing for too long."""


class DamagedMessage(LinkError):
    """A message has a wrong checksum: its writer violates the protocol."""


class LinkTimeout(LinkError):
    """The server is alive, but has not answered in time."""


class Refused(LinkError):
    """The server has refused a command; the state of the car is unchanged.

    `code` is one of `layout.Refusal`.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code

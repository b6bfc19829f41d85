"""Exceptions of the link; each message states what the user can do."""

from trackfeatures.errors import UserError


class LinkError(UserError):
    """Raised if the link cannot be opened or is lost."""


class NoServer(LinkError):
    """Raised if there is no server of this name (yet)."""


class NameInUse(LinkError):
    """Raised if another process has this name, or has this role on the link."""


class LayoutMismatch(LinkError):
    """Raised if server and client use different layouts of the memory."""


class ServerDied(LinkError):
    """Raised if the server's process has ended or it has closed the link."""


class ClientLost(LinkError):
    """Raised if the server's client has died, or has sent nothing for too long."""


class DamagedMessage(LinkError):
    """Raised if a message has a wrong checksum: its writer violates the protocol."""


class LinkTimeout(LinkError):
    """Raised if the server is alive but has not answered in time."""


class Refused(LinkError):
    """Raised if the server has refused a command; the state of the car is unchanged.

    `code` is one of `layout.Refusal`.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code

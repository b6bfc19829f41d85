"""Exceptions of the link; each message states what the user can do."""

from trackfeatures.errors import UserError


class LinkError(UserError):
    """Raised if the link cannot be opened or is lost."""


class NoServer(LinkError):
    """Raised if no server of this name is running."""


class NameInUse(LinkError):
    """Raised if a server of this name is running already, or if the server has a client already."""


class LayoutMismatch(LinkError):
    """Raised if server and client use different layouts of the memory."""


class ServerDied(LinkError):
    """Raised if the server's process has ended, or if the server has closed the link."""


class ClientLost(LinkError):
    """Raised if the server's client has died, or has sent nothing for longer than `--patience`
    seconds."""


class DamagedMessage(LinkError):
    """Raised if a message has a wrong checksum: its writer violates the protocol."""


class LinkTimeout(LinkError):
    """Raised if the server is alive but has not answered in time."""


class Refused(LinkError):
    """Raised if the server has refused a command; the state of the car is unchanged.

    `code` is the value of a `layout.Refusal`.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code

"""What can go wrong on the link, each with what to do about it."""

from trackfeatures.errors import UserError


class LinkError(UserError):
    """The link cannot be made or is lost."""


class NoEngine(LinkError):
    """Nobody serves a link of that name (yet)."""


class NameInUse(LinkError):
    """Somebody else holds this name, or this end of the link."""


class LayoutMismatch(LinkError):
    """The two sides were built for different layouts of the memory."""


class EngineDied(LinkError):
    """The engine's process is gone, or it has closed the link."""


class ClientLost(LinkError):
    """The engine's client has died, or says nothing any more."""


class DamagedMessage(LinkError):
    """A message whose checksum is wrong: its writer does not keep to the protocol."""


class LinkTimeout(LinkError):
    """The engine lives, but has not answered in time."""


class Refused(LinkError):
    """The engine lives and has refused a command; the car stands where it stood.

    `code` is one of `layout.Refusal`.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code

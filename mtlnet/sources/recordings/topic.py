"""A topic of a recording."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording. `count` is its number of messages, None if it is unknown."""

    name: str
    schema: str
    encoding: str
    """Encoding of its messages: "cdr", "protobuf", "json", ..."""
    count: int | None = None

    def __str__(self) -> str:
        messages = "" if self.count is None else f", {self.count} messages"
        return f"{self.name} ({self.schema}{messages})"

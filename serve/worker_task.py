"""What a supervisor tells a new worker to do."""

import json
from dataclasses import asdict, dataclass

from serve.limits import Limits


@dataclass(frozen=True)
class Task:
    """What a worker is to do. `expected` is the hash its weights must have, None: any."""

    folder: str
    generation: int
    expected: str | None
    listener: int
    memory: int
    slots: int
    slot: int
    limits: Limits

    def as_line(self) -> bytes:
        """As it goes over the socket."""
        return json.dumps(asdict(self)).encode() + b"\n"


def read_task(line: str) -> Task:
    """The task in a line."""
    content = json.loads(line)
    return Task(**{**content, "limits": Limits(**content["limits"])})

"""The engine's loop: takes commands from the link, lets the simulation answer them, watches for
clients that come, leave and die.

In lock step it waits for a command for every control step. In real time it steps by the clock,
holding the last command, as long as an episode runs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from simulator.link.channel import Receiver, Sender
from simulator.link.errors import ClientLost
from simulator.link.handshake import EngineInfo, set_phase, write_header
from simulator.link.layout import (
    COMMAND,
    STATE,
    Mode,
    Phase,
    Request,
    image_bytes,
    segment_size,
)
from simulator.link.realtime import Clock
from simulator.link.segment import create
from simulator.link.simulation import Simulation

SLICE_S = 0.05
"""Between two looks at whether the other side lives."""

MakeSimulation = Callable[[Any, Any], Simulation]


_LAST = (Request.LEAVE, Request.QUIT)


@dataclass(frozen=True)
class Summary:
    """What an engine has done."""

    clients: int
    clients_lost: int
    """Died, without taking their leave."""
    episodes: int
    steps: int
    refused: int
    """Commands that could not be obeyed."""


class Engine:
    """Serves one link. `make_simulation` is given the record and the picture to write answers in.

    `once`: end with the first client. `patience_s`: a client that lives but sends nothing for
    longer is given up (0: never). Raises NameInUse, LinkError; see `segment`.
    """

    def __init__(
        self,
        name: str,
        info: EngineInfo,
        make_simulation: MakeSimulation,
        *,
        once: bool = False,
        patience_s: float = 600.0,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        size = image_bytes(info.image_width, info.image_height)
        self._segment = create(name, segment_size(info.image_width, info.image_height))
        self._inbox = Receiver(self._segment, COMMAND)
        self._outbox = Sender(self._segment, STATE, size)
        self._simulation = make_simulation(self._outbox.record, self._outbox.image)
        self._clock = Clock(info.frequency_hz) if info.mode is Mode.REALTIME else None
        self._once, self._patience_s, self._report = once, patience_s, report
        self._session, self._pid = 0, 0
        self._heard = 0.0
        self._done = False
        self._clients, self._lost = 0, 0
        write_header(self._segment, info)
        self._segment.publish()

    def serve(self) -> None:
        """Answer until a client asks to quit, or `once` and it leaves.

        Raises ClientLost when a client dies with `once`, or is silent beyond all patience.
        """
        while not self._done:
            if self._await_command():
                self._handle(self._inbox.record)
            elif self._session:
                self._watch_client()

    @property
    def summary(self) -> Summary:
        simulation = self._simulation
        return Summary(
            clients=self._clients,
            clients_lost=self._lost,
            episodes=simulation.episodes,
            steps=simulation.steps,
            refused=simulation.refused,
        )

    def close(self) -> None:
        """Say that it is over, and remove the segment."""
        set_phase(self._segment, Phase.CLOSED)
        self._outbox.wake()
        self._segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _await_command(self) -> bool:
        """Whether there is a new command, after a while of waiting for it."""
        if self._clock is None or not self._simulation.running:
            return self._inbox.wait(SLICE_S)
        self._outbox.record["late_steps"] += self._clock.wait()
        if self._inbox.poll():
            return True
        self._simulation.advance()
        self._send()
        return False

    def _handle(self, request: Any) -> None:
        if int(request["session"]) != self._session:
            self._welcome(request)
        self._heard = time.monotonic()
        record = self._outbox.record
        before = int(record["episode"]), int(record["step"])
        if self._inbox.damaged:
            self._simulation.reject("the command's checksum is wrong: see driverview_link.h")
        else:
            self._simulation.answer(request)
        if int(record["episode"]) != before[0] and self._clock is not None:
            self._clock.restart()
        elif self._clock is not None and before[1] == record["step"] and self._simulation.running:
            self._simulation.advance()  # refused: the clock goes on all the same
        record["session"], record["answers"] = request["session"], request["number"]
        self._send()
        if not self._inbox.damaged and request["request"] in _LAST:
            self._part(Request(int(request["request"])))

    def _send(self) -> None:
        self._outbox.record["number"] += 1
        self._outbox.send()

    def _welcome(self, request: Any) -> None:
        if self._session:
            self._lose()
        self._session, self._pid = int(request["session"]), int(request["client_pid"])
        self._clients += 1
        self._simulation.drop()
        self._report(f"client {self._pid} has come")

    def _part(self, request: Request) -> None:
        self._report(f"client {self._pid} has left")
        self._session = 0
        self._simulation.drop()
        self._done = self._once or request is Request.QUIT

    def _watch_client(self) -> None:
        if not self._segment.other_end_lives():
            self._lose()
        elif 0.0 < self._patience_s < time.monotonic() - self._heard:
            raise ClientLost(
                f"client {self._pid} lives, but has sent nothing for {self._patience_s:g} s; "
                "start the engine again, with a longer --patience for a slower client"
            )

    def _lose(self) -> None:
        said = f"client {self._pid} has died {self._simulation.place}"
        self._session = 0
        self._lost += 1
        self._simulation.drop()
        if self._once:
            raise ClientLost(said)
        self._report(said)

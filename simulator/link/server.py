"""The loop of a link server: reads commands, answers them with a Simulation, and checks that its
client is alive.

In lock-step mode the server waits for a command before each control step. In real-time mode it
steps by the wall clock and repeats the last command, as long as an episode runs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

from simulator.link.channel import Receiver, Sender
from simulator.link.errors import ClientLost
from simulator.link.handshake import ServerInfo, set_phase, write_header
from simulator.link.layout import (
    COMMAND,
    STATE,
    Mode,
    Phase,
    Request,
    image_bytes,
    segment_size,
)
from simulator.link.segment import POLL_INTERVAL_S, create
from simulator.link.simulation import Simulation
from simulator.world.pace import Pacer

MakeSimulation = Callable[[Any, Any], Simulation]


_LEAVING = (Request.LEAVE, Request.QUIT)


@dataclass(frozen=True)
class Summary:
    """Counts of a server's clients, episodes, steps and refused commands."""

    clients: int
    clients_lost: int
    """Number of clients that died without disconnecting."""
    episodes: int
    steps: int
    refused: int
    """Number of refused commands."""


class LinkServer:
    """Serves one link. `make_simulation(record, image)` builds the Simulation, which writes its
    answers to the STATE record `record` and to the image bytes `image`.

    If `once` is True, the server ends when the first client leaves. The server also ends if a
    connected client sends nothing for `patience_s` (0: no limit). `report` receives log lines.
    Raises NameInUse if a server of this name is running, and LinkError if there is not enough
    shared memory.
    """

    def __init__(
        self,
        name: str,
        info: ServerInfo,
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
        step_s = 1.0 / info.frequency_hz
        realtime = info.mode is Mode.REALTIME
        self._pacer = Pacer(step_s, catch_up_s=step_s) if realtime else None
        self._once, self._patience_s, self._report = once, patience_s, report
        self._session, self._pid = 0, 0
        self._last_command_s = 0.0
        self._done = False
        self._clients, self._lost = 0, 0
        write_header(self._segment, info)
        self._segment.publish()

    def serve(self, interrupted: Callable[[], bool] = lambda: False) -> None:
        """Answer requests until a client sends QUIT, until `interrupted()` returns True, or, if
        `once` is set, until the first client leaves.

        Raises ClientLost if a client sends nothing for `patience_s`, or if a client dies and `once`
        is set.
        """
        while not (self._done or interrupted()):
            if self._wait_for_command():
                self._handle(self._inbox.record)
            elif self._session:
                self._check_client()

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
        """Mark the link as closed, wake the client, and remove the segment."""
        set_phase(self._segment, Phase.CLOSED)
        self._outbox.wake()
        self._segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for_command(self) -> bool:
        """Wait for a command, at most POLL_INTERVAL_S or, in real-time mode, until the next step is
        due. Returns whether a command arrived. In real-time mode, step if no command arrived."""
        if self._pacer is None or not self._simulation.running:
            return self._inbox.wait(POLL_INTERVAL_S)
        self._outbox.record["late_steps"] += self._pacer.wait()
        if self._inbox.poll():
            return True
        self._simulation.advance()
        self._send()
        return False

    def _handle(self, request: Any) -> None:
        """Answer one request; accept its client if it is new, release the client if it leaves."""
        if int(request["session"]) != self._session:
            self._accept_client(request)
        self._last_command_s = time.monotonic()
        record = self._outbox.record
        before = int(record["episode"]), int(record["step"])
        if self._inbox.damaged:
            self._simulation.reject("the command's checksum is wrong: see driverview_link.h")
        else:
            self._simulation.answer(request)
        if int(record["episode"]) != before[0] and self._pacer is not None:
            self._pacer.restart()
        elif self._pacer is not None and before[1] == record["step"] and self._simulation.running:
            self._simulation.advance()  # in real time, a step follows a refused command too
        record["session"], record["answers"] = request["session"], request["number"]
        self._send()
        if not self._inbox.damaged and request["request"] in _LEAVING:
            self._release_client(Request(int(request["request"])))

    def _send(self) -> None:
        self._outbox.record["number"] += 1
        self._outbox.send()

    def _accept_client(self, request: Any) -> None:
        """Begin the session of a new client; a client that had a session counts as lost."""
        if self._session:
            self._drop_client()
        self._session, self._pid = int(request["session"]), int(request["client_pid"])
        self._clients += 1
        self._simulation.end_episode()
        self._report(f"client {self._pid} has connected")

    def _release_client(self, request: Request) -> None:
        self._report(f"client {self._pid} has disconnected")
        self._session = 0
        self._simulation.end_episode()
        self._done = self._once or request is Request.QUIT

    def _check_client(self) -> None:
        """Drop the client if it has died. Raises ClientLost if it was silent for too long."""
        if not self._segment.peer_is_alive():
            self._drop_client()
        elif 0.0 < self._patience_s < time.monotonic() - self._last_command_s:
            raise ClientLost(
                f"client {self._pid} is running, but has sent nothing for {self._patience_s:g} s; "
                "start the server again, with a longer --patience for a slower client"
            )

    def _drop_client(self) -> None:
        """End the session of a client that has died. Raises ClientLost if `once` is set."""
        message = f"client {self._pid} has died {self._simulation.position_text}"
        self._session = 0
        self._lost += 1
        self._simulation.end_episode()
        if self._once:
            raise ClientLost(message)
        self._report(message)

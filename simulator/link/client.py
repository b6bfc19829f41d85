"""A Python client of the shared-memory link to the simulator.

    from simulator.link.client import Link
    from simulator.vehicle.state import Command

    with Link("/driverview", wait_s=30.0) as link:
        message = link.reset(seed=1)
        while message.ended is None:
            message = link.step(Command(steer=-0.5 * message.state.to_middle, throttle=0.2))

Only one thread of one process may use a Link.
"""

import math
import os
import time
from typing import Self

from simulator.link.channel import Receiver, Sender, state_image_bytes
from simulator.link.config import DEFAULT_NAME
from simulator.link.errors import (
    DamagedMessage,
    LinkError,
    LinkTimeout,
    NoServer,
    Refused,
    ServerDied,
)
from simulator.link.handshake import ServerInfo, phase, read_header
from simulator.link.layout import COMMAND, STATE, Phase, Request
from simulator.link.message import Message, read_message, write_command
from simulator.link.segment import POLL_INTERVAL_S, Segment, attach
from simulator.link.sync import futex
from simulator.vehicle.state import Command

RETRY_S = 0.02


class Link:
    """A client connected to one server. `wait_s` is the time to wait for a server that does not
    exist yet, `timeout_s` the time to wait for each answer.

    `reset`, `step` and `quit` raise ServerDied if the server has ended, LinkTimeout if no answer
    arrives within `timeout_s`; `reset` and `step` raise Refused if the server refuses the request.
    The constructor raises NoServer if no server exists after `wait_s`, NameInUse if the server has
    another client, and LayoutMismatch if the server uses another memory layout.
    """

    def __init__(
        self, name: str = DEFAULT_NAME, *, timeout_s: float = 2.0, wait_s: float = 0.0
    ) -> None:
        futex.check_system()
        self._segment, self.info = _attach(name, wait_s)
        self._outbox = Sender(self._segment, COMMAND)
        self._inbox = Receiver(self._segment, STATE, state_image_bytes(self._segment))
        before = Receiver(self._segment, COMMAND)
        before.poll()
        self._timeout_s = timeout_s
        self._number = 0
        self._outbox.record["session"] = before.record["session"] + 1
        self._outbox.record["client_pid"] = os.getpid()
        self._closed = False

    def reset(
        self,
        *,
        seed: int | None = None,
        s: float | None = None,
        to_middle: float = 0.0,
        angle: float = 0.0,
        speed: float = 0.0,
    ) -> Message:
        """Start an episode and return its first message. `s` (m along the centre line) defaults to
        25 m before the start line; `to_middle` is in m, left positive, `angle` (track tangent minus
        yaw) in rad, `speed` in m/s. Without `seed` the server chooses a seed."""
        record = self._outbox.record
        record["request"] = Request.RESET
        record["seed"] = -1 if seed is None else seed
        record["start_s"] = math.nan if s is None else s
        record["start_to_middle"], record["start_angle"] = to_middle, angle
        record["start_speed"] = speed
        return self._request()

    def step(self, command: Command) -> Message:
        """Apply `command` for one control step and return the message with the state after this
        step. A server in real-time mode applies the command from its next step on."""
        write_command(self._outbox.record, command)
        return self._request()

    def latest(self) -> Message:
        """Return the newest message of the server without sending a request, to observe a server in
        real-time mode. Raises LinkError if the server has sent no message yet."""
        self._check_open()
        self._receive()
        until = time.monotonic() + self._timeout_s
        while self._inbox.torn:
            self._receive(POLL_INTERVAL_S)
            self._check_time(until)
        return self._message()

    def quit(self) -> None:
        """End the server and close this link."""
        self._outbox.record["request"] = Request.QUIT
        self._send_and_wait()
        self._closed = True
        self._segment.close()

    def close(self) -> None:
        """Disconnect. The server then waits for its next client, or ends if it runs with
        `--once`."""
        if self._closed:
            return
        try:
            self._outbox.record["request"] = Request.LEAVE
            self._send_and_wait()
        except LinkError:
            pass  # the server has ended or does not answer; nothing is left to do
        self._closed = True
        self._segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self) -> Message:
        """Send the command and return its answer. Raises Refused if the server refuses it."""
        self._send_and_wait()
        record = self._inbox.record
        if record["error"]:
            text = record["error_text"].decode(errors="ignore")
            raise Refused(int(record["error"]), text)
        return self._message()

    def _send_and_wait(self) -> None:
        """Send the command and wait for the message that answers it."""
        self._check_open()
        self._number += 1
        record = self._outbox.record
        record["number"], record["seen"] = self._number, self._inbox.record["number"]
        self._outbox.send()
        until = time.monotonic() + self._timeout_s
        while not (self._receive(POLL_INTERVAL_S) and self._answered()):
            self._check_time(until)

    def _check_time(self, until: float) -> None:
        """Raise LinkTimeout after the monotonic time `until` (s)."""
        if time.monotonic() > until:
            raise LinkTimeout(
                f"{self._server} is running, but has not answered within {self._timeout_s:g} s"
                "; is it stopped, or too busy? A longer timeout_s waits longer"
            )

    def _receive(self, seconds: float = 0.0) -> bool:
        """Return whether a message arrived within `seconds`. Raises ServerDied, DamagedMessage."""
        came = self._inbox.wait(seconds) if seconds else self._inbox.poll()
        if not came and not self._segment.peer_is_alive():
            came = self._inbox.poll()  # a last message may have arrived before the server ended
            if not came:
                self._raise_server_died()
        if came and self._inbox.damaged:
            raise DamagedMessage(f"a message of {self._server} is damaged: its checksum is wrong")
        return came

    def _answered(self) -> bool:
        mine, theirs = self._outbox.record, self._inbox.record
        return bool(theirs["session"] == mine["session"] and theirs["answers"] == mine["number"])

    def _raise_server_died(self) -> None:
        ended = phase(self._segment) == Phase.CLOSED
        self._closed = True
        self._segment.close()
        raise ServerDied(
            f"{self._server} has {'ended' if ended else 'died'} (the last message was of step "
            f"{int(self._inbox.record['step'])}); start it again"
        )

    def _message(self) -> Message:
        record, image = self._inbox.record, None
        if not record["number"]:
            raise LinkError(f"{self._server} has sent nothing yet; ask for a reset first")
        height, width = self.info.image_height, self.info.image_width
        if width:
            image = self._inbox.image[: height * width * 3].reshape(height, width, 3)
        return read_message(record, image)

    def _check_open(self) -> None:
        if self._closed or self._segment.descriptor < 0:
            raise LinkError(f"the link to {self._server} is closed; make a new one")

    @property
    def _server(self) -> str:
        return f"the server of {self._segment.name} (process {self.info.engine_pid})"


def _attach(name: str, wait_s: float) -> tuple[Segment, ServerInfo]:
    """Attach to a server that is ready, retrying for `wait_s`."""
    until = time.monotonic() + wait_s
    while True:
        try:
            segment = attach(name)
            try:
                return segment, read_header(segment)
            except BaseException:
                segment.close()
                raise
        except NoServer:
            if time.monotonic() >= until:
                raise
        time.sleep(RETRY_S)

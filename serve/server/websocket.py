"""WebSockets with deadlines, and with limits for the work and memory that a client can cause.

This is uvicorn's protocol on the library websockets. A handshake that the library refuses is
answered with a problem. The handshake, each message, and the reading of answers have deadlines.
Small frames (pings, fragments, short messages) and texts have a rate limit, since each costs as
much as a large frame. Messages count in the memory budget for bodies until the service takes them.
A client that exceeds a limit gets the reason in the close frame, which it can read for 0.5 s.
"""

from asyncio import Transport
from collections import deque
from math import inf
from typing import Any

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import HeaderLineTooLong, RequestLineTooLong, TooManyHeaders
from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import State

from serve.problems import (
    HEAD_TOO_LARGE,
    INVALID_REQUEST,
    MALFORMED,
    OVERLOADED,
    RATE_LIMITED,
    TOO_SLOW,
    Problem,
)
from serve.replies import encode_head, problem_reply
from serve.scheduling.body_budget import BodyShare
from serve.server import guard as guards
from serve.server.guard import ConnectionGuard, Group

SLICE_BYTES = 4096  # bytes parsed between two counts of small frames; hundreds of frames fit in
SMALL_BYTES = 2048  # a frame with fewer bytes is small
SMALL_FRAMES = 500  # small frames and texts per second, and in one burst
MAX_TEXT_BYTES = 4096  # size of a text message: at least 1,024 characters in UTF-8
TEXT_COST = 4  # bytes of memory per byte of a text: one emoji makes Python use 4 per character


class GuardedWebSocket(WebSocketsSansIOProtocol):
    """One WebSocket connection with deadlines and limits."""

    def __init__(self, *arguments: Any, guard: ConnectionGuard, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._guard = guard
        self.group: Group = {}
        self.network = ""
        self.since_s = 0.0  # the time of its last message
        self._discarding = False
        self._handshake_end_s = self._message_end_s = inf
        self._reading_end_s = self._closing_end_s = inf
        self._small_frames, self._counted_s = float(SMALL_FRAMES), 0.0
        self._share = None if guard.bodies is None else BodyShare(guard.bodies)
        self._frame_bytes = 0  # size of the frames of the current message
        # Sizes of the complete messages that the service has not taken yet.
        self._queued_bytes: deque[int] = deque()
        self._draining = False
        self._owed = 0  # answers to images that the service has taken

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        now = self._guard.place(self, self._guard.streams)
        self._counted_s, self._handshake_end_s = now, now + self._guard.limits.head_s
        transport.pause_reading()  # frames must wait until the handshake is answered

    def connection_lost(self, exc: Exception | None) -> None:
        self._guard.forget(self)
        self._drop_messages()
        super().connection_lost(exc)
        self.conn.parser.close()  # breaks a reference cycle

    @property
    def lingers(self) -> bool:
        """Whether the close frame was sent and the client has not closed the connection yet."""
        return self._discarding and not self.transport.is_closing()

    def begin_draining(self) -> None:
        """Ignore further bytes: an image that is still incomplete gets no answer."""
        self._draining = True

    def drain(self, elapsed_s: float) -> bool:
        """Close the connection if all images are answered, however long ago (`elapsed_s`) draining
        began. Returns whether it is closing."""
        if self.handshake_complete and not (self._owed or self._queued_bytes):
            self.end_draining()
        return self._discarding or self.transport.is_closing()

    def end_draining(self) -> None:
        """Close the connection with the reason that the service stops."""
        if not (self._discarding or self.transport.is_closing()):
            self.fail(CloseCode.SERVICE_RESTART, "the service stops or restarts; connect again")

    def data_received(self, data: bytes) -> None:
        if self._draining and not self._discarding:
            return
        self._guard.reading = self
        for at in range(0, len(data), SLICE_BYTES):
            if self._discarding:
                return
            super().data_received(data[at : at + SLICE_BYTES])
        if self.conn.handshake_exc is not None and not self.handshake_initiated:
            self._refuse_handshake(self.conn.handshake_exc)
        elif not (self.frames or self.conn.reader.buffer):
            self._message_end_s = inf
        elif self._message_end_s == inf:
            self._message_end_s = self._guard.clock() + self._guard.limits.body_s
        if not self._discarding:
            self._count_message()
            if len(data) >= guards.PAUSE_BYTES and self.transport.is_reading():
                self.transport.pause_reading()
                self.loop.call_soon(self._read_on)

    def _read_on(self) -> None:
        """Resume reading after the pause that follows a large read, unless reading was also paused
        for another reason."""
        if not (self.read_paused or self.transport.is_closing()):
            self.transport.resume_reading()

    def _count_message(self) -> None:
        """Reserve the received bytes of messages in the budget for bodies."""
        if self._share is None:
            return
        try:
            frames = self._frame_bytes if self.frames else 0
            self._share.hold(sum(self._queued_bytes) + frames + len(self.conn.reader.buffer))
        except Problem as problem:
            self._guard.count_closed(problem.type)
            self.fail(CloseCode.TRY_AGAIN_LATER, problem.detail)

    def _drop_messages(self) -> None:
        """Drop the received messages and release their bytes in the budget."""
        queued = [self.queue.get_nowait() for _ in range(self.queue.qsize())]
        for message in queued:
            if message["type"] != "websocket.receive":
                self.queue.put_nowait(message)
        self._queued_bytes.clear()
        self.frames = []
        self.conn.reader.discard()
        if self._share is not None:
            self._share.close()

    def handle_text(self, event: Frame) -> None:
        self._frame_bytes = len(event.data)
        if not self._refuse_long_text("text"):
            super().handle_text(event)

    def handle_bytes(self, event: Frame) -> None:
        self._frame_bytes = len(event.data)
        super().handle_bytes(event)

    def handle_cont(self, event: Frame) -> None:
        self._frame_bytes += len(event.data)
        if not self._refuse_long_text(self.curr_msg_data_type):
            super().handle_cont(event)

    def _refuse_long_text(self, kind: str) -> bool:
        """Close the connection if the current message is a text above MAX_TEXT_BYTES, before it is
        decoded. Returns whether it was closed."""
        if kind != "text" or self._frame_bytes <= MAX_TEXT_BYTES:
            return False
        self._guard.count_closed(INVALID_REQUEST)
        self.fail(CloseCode.MESSAGE_TOO_BIG, f"a text has at most {MAX_TEXT_BYTES} bytes")
        return True

    def _refuse_handshake(self, error: Exception) -> None:
        """Answer a handshake that the library refuses, with a problem."""
        self.conn.data_to_send()  # discards the library's plain-text reply
        self.conn.handshake_exc = None  # its traceback references this object
        problem = Problem(MALFORMED, "this is not the handshake of a WebSocket (RFC 6455, 4.1)")
        if isinstance(error, RequestLineTooLong | HeaderLineTooLong | TooManyHeaders):
            problem = Problem(HEAD_TOO_LARGE, f"the handshake is too large: {error}")
        self._guard.count_closed(problem.type)
        self._drop_messages()
        reply = problem_reply(problem, (b"connection", b"close"))
        self._close_after(encode_head(reply) + reply.body)

    def handle_events(self) -> None:
        small = sum(
            isinstance(event, Frame)
            and (len(event.data) < SMALL_BYTES or event.opcode is Opcode.TEXT)
            for event in self.conn.events
        )
        if small and not self._allow(small):
            self.conn.events.clear()
            self._guard.count_closed(RATE_LIMITED)
            reason = f"more than {SMALL_FRAMES} small frames and texts per second"
            self.fail(CloseCode.POLICY_VIOLATION, reason)
            return
        super().handle_events()

    def _allow(self, small: int) -> bool:
        """Count `small` small frames; return False if they exceed the allowed rate."""
        self._small_frames -= small
        if self._small_frames < 0:
            now = self._guard.clock()
            earned = (now - self._counted_s) * SMALL_FRAMES
            self._small_frames = min(self._small_frames + earned, SMALL_FRAMES)
            self._counted_s = now
        return self._small_frames >= 0

    def handle_ping(self) -> None:
        """Send a pong, unless the client does not read. RFC 6455, 5.5.3, allows missing pongs."""
        output = self.conn.data_to_send()
        if self.writable.is_set() and not self._discarding:
            self.transport.write(b"".join(output))

    def send_receive_event_to_app(self) -> None:
        self._guard.place(self, self.group)
        if self.curr_msg_data_type == "text":
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self.frames = []
                self.fail(CloseCode.INVALID_DATA, "the text is not UTF-8")
                return
        if not self.close_sent:  # after a close frame, messages are dropped
            cost = TEXT_COST if self.curr_msg_data_type == "text" else 1
            self._queued_bytes.append(cost * self._frame_bytes)
        super().send_receive_event_to_app()

    async def receive(self) -> Any:
        message = await super().receive()
        if message["type"] == "websocket.receive" and self._queued_bytes:
            self._queued_bytes.popleft()
            self._count_message()
            self._owed += message.get("bytes") is not None
        return message

    async def send(self, message: Any) -> None:
        await self.writable.wait()
        if self._discarding:
            raise ClientDisconnected
        await super().send(message)
        if message["type"] == "websocket.send":
            self._owed -= 1
        elif message["type"] == "websocket.accept":
            self._handshake_end_s = inf
            self.transport.resume_reading()
        elif message["type"] == "websocket.http.response.body":
            self.handshake_complete = True  # otherwise uvicorn logs an error for a refusal

    def pause_writing(self) -> None:
        super().pause_writing()
        self._reading_end_s = self._guard.clock() + self._guard.limits.idle_s

    def resume_writing(self) -> None:
        super().resume_writing()
        self._reading_end_s = inf

    def give_way(self) -> None:
        """Close this WebSocket to make room for a new connection."""
        self.fail(CloseCode.TRY_AGAIN_LATER, "closed for another client: no message for long")

    def end_slow_body(self, now: float) -> int:
        """Close the connection if a message has been arriving for 0.1 s (EVICTABLE_S) at `now` (in
        s). Returns the number of freed bytes: those that this connection held in the budget."""
        held = 0 if self._share is None else self._share.size
        since_s = self._message_end_s - self._guard.limits.body_s
        if not held or self._discarding or now - since_s < guards.EVICTABLE_S:
            return 0
        self._guard.count_closed(OVERLOADED)
        self.fail(CloseCode.TRY_AGAIN_LATER, "the bodies in flight need too much memory")
        return held

    def expire(self, now: float) -> None:
        """Close the connection if one of its deadlines is before `now` (in s of the guard's
        clock)."""
        if self._discarding or self.transport.is_closing():
            if self._closing_end_s == inf:
                self._closing_end_s = now + guards.LINGER_S
            elif now >= self._closing_end_s:
                self.transport.abort()
        elif now >= min(self._handshake_end_s, self._reading_end_s):
            self._guard.count_closed(TOO_SLOW)
            self.transport.abort()
        elif now >= self._message_end_s:
            limit_s = self._guard.limits.body_s
            if self.read_paused:  # the delay is the service's, not the client's
                self._message_end_s = now + limit_s
                return
            self._guard.count_closed(TOO_SLOW)
            self.fail(CloseCode.POLICY_VIOLATION, f"a message took more than {limit_s:g} s")

    def fail(self, code: CloseCode, reason: str) -> None:
        """Close with this WebSocket code and reason; discard further bytes of the client."""
        if self.conn.state is not State.OPEN:
            self.transport.abort()
            return
        self.conn.fail(code, reason)
        self.handle_parser_exception()

    def handle_parser_exception(self) -> None:
        """Send the close frame, then read and discard further bytes for 0.5 s (LINGER_S).

        Closing a connection with unread bytes resets it: the client would lose the close frame.
        """
        closing = self.conn.close_sent
        if closing is None:
            self.transport.abort()
            return
        self._drop_messages()
        self.queue.put_nowait(
            {"type": "websocket.disconnect", "code": closing.code, "reason": closing.reason}
        )
        self._close_after(b"".join(self.conn.data_to_send()))

    def _close_after(self, output: bytes) -> None:
        """Send `output` as the last bytes; abort the connection after LINGER_S."""
        self._discarding = self.close_sent = True
        self.stop_keepalive()
        self._guard.place(self, self._guard.refused)
        if self.transport.is_closing():
            return
        self.transport.write(output)
        self.transport.write_eof()
        if self.read_paused:
            self.read_paused = False
        self.transport.resume_reading()
        self.close_timer = self.loop.call_later(guards.LINGER_S, self.transport.abort)

"""Reading from a connection pauses after a large read, until nothing else keeps it paused."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from uvicorn.protocols.http.flow_control import FlowControl

from serve.config import Limits
from serve.server.guard import PAUSE_BYTES, REFUSAL_PAUSE_S, ConnectionGuard


class RecordingTransport:
    """Stands in for a socket's transport; `reads` says whether it is read."""

    reads = True

    def pause_reading(self) -> None:
        self.reads = False

    def resume_reading(self) -> None:
        self.reads = True

    def is_closing(self) -> bool:
        return False


def make_connection() -> Any:
    transport: Any = RecordingTransport()
    loop = asyncio.get_running_loop()
    return SimpleNamespace(transport=transport, flow=FlowControl(transport), loop=loop)


@pytest.mark.parametrize(("size", "reads"), [(PAUSE_BYTES - 1, True), (PAUSE_BYTES, False)])
def test_reading_pauses_for_one_turn_of_the_loop_after_a_large_read(size: int, reads: bool) -> None:
    async def run() -> None:
        guard, connection = ConnectionGuard(Limits()), make_connection()
        guard.pause_after(connection, size)
        assert connection.transport.reads is reads
        await asyncio.sleep(0)
        assert connection.transport.reads

    asyncio.run(run())


def test_a_client_that_reads_no_replies_or_was_refused_is_not_read_sooner() -> None:
    async def run() -> None:
        guard, slow, refused = ConnectionGuard(Limits()), make_connection(), make_connection()
        for connection in (slow, refused):
            guard.pause_after(connection, PAUSE_BYTES)
        slow.flow.pause_writing()
        guard.pause_reading(refused)
        await asyncio.sleep(0)
        assert not slow.transport.reads
        assert not refused.transport.reads
        await asyncio.sleep(10 * REFUSAL_PAUSE_S)
        assert refused.transport.reads
        assert not slow.transport.reads

    asyncio.run(run())

"""The lock for which clients take turns; test_frame_queue.py tests the turns of the queue."""

import asyncio
from contextlib import suppress

from serve.scheduling.fair_lock import FairLock


def order_of(clients: list[str], cancelled: tuple[int, ...] = ()) -> list[int]:
    """The order in which waiters, one for each of `clients`, get the lock, without `cancelled`."""

    async def run() -> list[int]:
        lock, order = FairLock(), list[int]()

        async def work(number: int, client: str) -> None:
            async with lock.held(client):
                assert not inside
                inside.append(number)
                await asyncio.sleep(0)
                order.append(inside.pop())

        inside = list[int]()
        async with lock.held("first"):
            tasks = [asyncio.create_task(work(n, client)) for n, client in enumerate(clients)]
            await asyncio.sleep(0)
            for number in cancelled:
                tasks[number].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        async with asyncio.timeout(5), lock.held("last"):
            return order

    return asyncio.run(run())


def test_clients_take_turns() -> None:
    """A client does not wait until all three requests of another client are done."""
    assert order_of(["10.0.0.1"] * 3 + ["10.0.0.2"] * 2) == [0, 3, 1, 4, 2]
    # Addresses of one IPv6 network are one client.
    assert order_of(["2001:db8::1", "2001:db8::2", "10.0.0.2"]) == [0, 2, 1]


def test_one_that_gives_up_is_passed_over() -> None:
    assert order_of(["10.0.0.1", "10.0.0.2", "10.0.0.3"], cancelled=(0, 1)) == [2]
    assert order_of(["10.0.0.1"], cancelled=(0,)) == []


def test_a_turn_that_comes_to_one_that_was_cancelled_goes_on() -> None:
    async def run() -> bool:
        lock = FairLock()

        async def hold() -> None:
            async with lock.held("10.0.0.1"):
                raise AssertionError

        async with lock.held("10.0.0.2"):
            task = asyncio.create_task(hold())
            await asyncio.sleep(0)
        task.cancel()  # it has got the lock, but has not run yet
        with suppress(asyncio.CancelledError):
            await task
        async with asyncio.timeout(5), lock.held("10.0.0.3"):
            return task.cancelled()

    assert asyncio.run(run())

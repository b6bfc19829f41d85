"""The client with the service, and with servers that break off, do not reply or send nonsense."""

import asyncio
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from runtime.sockets import bind
from serve.client import Client, ServiceError, sync
from serve.client.aio import AsyncClient
from serve.config import Limits
from tests.serve.conftest import (
    CARD,
    JPEG,
    PATIENCE_S,
    PNG,
    Clock,
    Served,
    constant_engine,
    serving,
)


@contextmanager
def listener(behave: Callable[[socket.socket, int], object]) -> Iterator[str]:
    """A server that calls `behave` with each connection and its number; yields its URL."""
    server = bind("127.0.0.1", 0)
    server.listen()

    def run() -> None:
        number = 0
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                behave(connection, number)
            number += 1

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
    finally:
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        thread.join(PATIENCE_S)


def reply(content: bytes, status: str = "200 OK") -> bytes:
    return b"HTTP/1.1 %s\r\nContent-Length: %d\r\n\r\n%s" % (status.encode(), len(content), content)


def test_a_token_is_sent_as_given_or_as_the_environment_has_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    token = "a-token-of-some-length"
    with serving(limits=Limits(token=token)) as service:
        with Client(service.url) as unknown, pytest.raises(ServiceError, match="token") as refused:
            unknown.features(JPEG)
        assert refused.value.status == 401
        with Client(service.url, token=token) as known:
            assert known.features(JPEG)["model"] == CARD.model_hash
        monkeypatch.setenv("DRIVERVIEW_TOKEN", token)

        async def ask() -> str:
            async with AsyncClient(service.url) as client:
                return str((await client.features(JPEG))["model"])

        assert asyncio.run(ask()) == CARD.model_hash


def test_answers_are_those_of_the_service(service: Served) -> None:
    with Client(service.url + "/") as client:
        assert client.ready()
        client.wait_until_ready(PATIENCE_S)
        answer = client.features(JPEG, frame_id="17")
        assert answer["distances_m"]["ml"] == pytest.approx(-2.0, abs=1e-5)
        assert answer["frame_id"] == "17"
        assert client.features(PNG)["model"] == CARD.model_hash
        assert client.features(JPEG, fov_y_deg=90)["crop_px"] is not None
        with pytest.raises(ServiceError, match="field of view"):
            client.features(JPEG, fov_y_deg=20.5)
        assert client.model()["camera"]["width"] == 280
    assert Client(f"127.0.0.1:{service.port}").ready()


def test_a_header_that_cannot_be_sent_is_an_error_and_the_next_request_works(
    service: Served,
) -> None:
    with Client(service.url) as client:
        for name in ("line\nbreak", "\N{SNOWMAN}"):
            with pytest.raises(ServiceError, match="X-Frame-Id has characters"):
                client.features(JPEG, frame_id=name, deadline_s=PATIENCE_S)
            assert client.features(JPEG)["frame_id"] is None
    with pytest.raises(ServiceError, match="Authorization has characters"):
        Client(service.url, token="a\nb")


def test_a_request_that_was_interrupted_does_not_spoil_the_next(
    service: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_connection: object) -> None:
        raise KeyboardInterrupt

    with Client(service.url) as client:
        client.ready()
        monkeypatch.setattr("http.client.HTTPConnection.getresponse", interrupt)
        with pytest.raises(KeyboardInterrupt):
            client.features(JPEG)
        monkeypatch.undo()
        assert client.features(JPEG)["model"] == CARD.model_hash


def test_a_deadline_may_be_far_away(service: Served) -> None:
    with Client(service.url) as client:
        for deadline_s in (1e15, float("inf")):
            assert client.features(JPEG, deadline_s=deadline_s)["model"] == CARD.model_hash


def test_asyncio_clients_ask_concurrently(service: Served) -> None:
    async def ask(number: int) -> dict[str, Any]:
        async with AsyncClient(service.url) as client:
            assert await client.ready()
            assert (await client.model())["model"] == CARD.model_hash
            with pytest.raises(ServiceError, match="4 bytes"):
                await client.features(b"text")
            assert (await client.features(JPEG, fov_y_deg=90))["crop_px"] is not None
            return await client.features(JPEG, frame_id=str(number), deadline_s=60)

    async def crowd() -> list[dict[str, Any]]:
        return await asyncio.gather(*(ask(number) for number in range(4)))

    answers = asyncio.run(crowd())
    assert [answer["frame_id"] for answer in answers] == ["0", "1", "2", "3"]


def test_the_asyncio_client_has_every_method_of_the_client(service: Served) -> None:
    assert {name for name in dir(Client) if not name.startswith("_")} <= set(dir(AsyncClient))

    async def wait() -> str:
        async with AsyncClient(f"{service.url}/") as client:
            await client.wait_until_ready()
            return client.url

    assert asyncio.run(wait()) == service.url


def test_an_asyncio_client_may_be_closed_twice(service: Served) -> None:
    async def close_early() -> None:
        async with AsyncClient(service.url) as client:
            assert await client.ready()
            await client.close()

    asyncio.run(close_early())


def test_a_refusal_carries_the_problem(service: Served) -> None:
    with Client(service.url) as client:
        with pytest.raises(ServiceError, match="4 bytes that begin with b'text'") as caught:
            client.features(b"text")
        assert caught.value.status == 422
        assert caught.value.problem == "/problems/not-an-image"
        assert client.features(JPEG)


def test_a_wait_that_times_out_raises_the_reason_of_the_service() -> None:
    gate = threading.Event()
    engine = constant_engine()
    with serving(engine, lambda _engine: gate.wait(PATIENCE_S)) as served:
        client = Client(served.url)
        assert not client.ready()
        with pytest.raises(ServiceError, match=r"not ready within 0\.3 s.*warming up"):
            client.wait_until_ready(0.3)
        threading.Timer(0.2, gate.set).start()
        client.wait_until_ready(PATIENCE_S)
        assert client.ready()


def test_a_dropped_idle_connection_is_opened_again() -> None:
    def one_answer_each(connection: socket.socket, number: int) -> None:
        connection.recv(65536)
        connection.sendall(reply(b'{"number": %d}' % number))

    with listener(one_answer_each) as url, Client(url) as client:
        assert [client.model()["number"] for _ in range(3)] == [0, 1, 2]


def test_with_a_deadline_requests_are_retried_until_then_where_that_may_help(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    full = b'{"type": "/problems/overloaded", "retry_after_ms": 5}'
    gone = b'{"type": "/problems/superseded", "retry_after_ms": 5}'
    asked: list[bytes] = []

    def full_twice(connection: socket.socket, number: int) -> None:
        asked.append(connection.recv(65536))
        busy = reply(full, "503 Service Unavailable")
        connection.sendall(busy if number < 2 else reply(b'{"number": %d}' % number))

    with listener(full_twice) as url:
        assert Client(url).features(b"image", deadline_s=60, stream="front") == {"number": 2}
        sent = [float(re.findall(rb"X-Deadline-Ms: (\S+)", found)[0]) for found in asked]
        assert 60_000 >= sent[0] > sent[1] > sent[2] > 0
        assert b"X-Stream-Id: front" in asked[0]

    def always(content: bytes) -> Callable[[socket.socket, int], None]:
        def behave(connection: socket.socket, _number: int) -> None:
            asked.append(connection.recv(65536))
            connection.sendall(reply(content, "503 Service Unavailable"))

        return behave

    # The clock advances only in the pauses between requests, by the 15 s that the service advises.
    clock = Clock()
    monkeypatch.setattr(sync, "time", SimpleNamespace(monotonic=clock, sleep=clock.advance))
    monkeypatch.setattr(sync, "RETRY_S", 20.0)
    for content, count in ((gone, 1), (full, 4)):
        asked.clear()
        content = content.replace(b": 5}", b": 15000}")
        with listener(always(content)) as url, pytest.raises(ServiceError, match="503") as caught:
            Client(url).features(b"image", deadline_s=60)
        assert caught.value.retry_after_s == 15.0
        assert len(asked) == count


def test_a_service_that_closes_every_connection_is_an_error() -> None:
    with listener(lambda connection, _number: connection.recv(65536)) as url:
        client = Client(url)
        with pytest.raises(ServiceError, match="closed the connection"):
            client.model()


def test_a_silent_service_and_a_port_without_one() -> None:
    quiet = threading.Event()
    with listener(lambda _connection, _number: quiet.wait(PATIENCE_S)) as url:
        with pytest.raises(ServiceError, match=r"did not reply within 0\.2 s"):
            Client(url, timeout_s=0.2).features(JPEG)
        with pytest.raises(ServiceError, match=r"did not reply within 0\.\d+ s"):
            Client(url, timeout_s=PATIENCE_S).features(JPEG, deadline_s=0.2)
        quiet.set()
    with bind("127.0.0.1", 0) as silent:  # bound to the port, but not listening
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(ServiceError, match="start one with `serve`"):
            Client(url).features(JPEG)


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (reply(b"<html>"), "not with a JSON object"),
        (reply(b"[1]"), "not with a JSON object"),
        (reply(b"{}", "500 Oops"), "answered 500: no reason given"),
        (b"SSH-2.0-OpenSSH\r\n", "does not answer as HTTP"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n{}", "does not answer as HTTP"),
    ],
)
def test_a_server_that_is_not_this_service(sent: bytes, message: str) -> None:
    def behave(connection: socket.socket, _number: int) -> None:
        connection.recv(65536)
        connection.sendall(sent)

    with listener(behave) as url, pytest.raises(ServiceError, match=message):
        Client(url).model()


@pytest.mark.parametrize(
    "url",
    [
        "",
        "ftp://x:1",
        "http://",
        "http://x:port",
        "http://x:99999",
        "http://[::1",
        "http://exa..mple:8000",
        f"http://{'x' * 64}.org",
        "http://host/\xe4",
        "http://host/a b",
        "http://a b",
        "http://a\0b",
    ],
)
def test_invalid_addresses(url: str) -> None:
    with pytest.raises(ServiceError, match="is not the address of a service"):
        Client(url)


@pytest.mark.parametrize(
    ("url", "host", "port"),
    [
        ("http://[::1]", "::1", 80),
        ("https://[2001:db8::abcd]", "2001:db8::abcd", 443),
        ("http://[fe80::1%25eth0]", "fe80::1%eth0", 80),
        ("http://host", "host", 80),
    ],
)
def test_an_address_without_a_port_has_the_port_of_its_scheme(
    url: str, host: str, port: int
) -> None:
    connection = Client(url)._connection
    assert (connection.host, connection.port) == (host, port)


@pytest.mark.parametrize("listens", ["127.0.0.1", "::1"])
def test_localhost_is_both_loopback_addresses(listens: str) -> None:
    with serving(host=listens) as service:
        literal = f"[{listens}]" if ":" in listens else listens
        for host in ("localhost", "LOCALHOST", literal):
            with Client(f"http://{host}:{service.port}") as client:
                assert client.ready()
                assert client.features(JPEG)["model"] == CARD.model_hash

        async def ask() -> bool:
            async with AsyncClient(f"localhost:{service.port}") as client:
                return await client.ready()

        assert asyncio.run(ask())
        with pytest.raises(ServiceError, match="no service listens at http://localhost:1;"):
            Client("localhost:1").model()


def test_a_zone_of_an_ipv6_address_is_used_and_ignored_by_the_service(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def connect(place: tuple[str, int], *_: Any) -> socket.socket:
        asked.append(place[0])
        return socket.create_connection(("::1", place[1]), PATIENCE_S)

    monkeypatch.setattr(sync, "connect", connect)
    limits = Limits(hosts=("fe80::1%eth0",))
    with serving(limits=limits, host="::1") as service:
        for zone in ("%25eth0", "%eth0"):
            with Client(f"http://[fe80::1{zone}]:{service.port}") as client:
                assert client.model()["model"] == CARD.model_hash
        with (
            Client(f"http://[fe80::2]:{service.port}") as client,
            pytest.raises(ServiceError, match="the Host is"),
        ):
            client.model()
    assert asked == ["fe80::1%eth0", "fe80::1%eth0", "fe80::2"]

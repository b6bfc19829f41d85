"""What the service takes from its clients: connections, deadlines, headers, tokens, rates."""

import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager

import pytest

from serve.api.problems import Problem
from serve.config import Limits, is_loopback
from serve.scheduling.rate_limit import RateLimiter
from serve.workers import shared_memory
from tests.serve.conftest import FakeEngine, Gate, Served, jpeg, outputs, picture, serving, until
from tests.serve.test_app import assert_problem

JPEG = jpeg(picture())
HEAD = b"POST /features HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\n"


def limited(limits: Limits) -> AbstractContextManager[Served]:
    return serving(FakeEngine(lambda _image: outputs()), limits=limits)


def dial(service: Served) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", service.port))
    connection.settimeout(20)
    return connection


def last_words(connection: socket.socket) -> tuple[int, dict[str, object]]:
    """The status and problem with which the service ends a connection."""
    received = b""
    while part := connection.recv(65536):
        received += part
    head, _, body = received.partition(b"\r\n\r\n")
    assert b"connection: close" in head
    return int(head.split()[1]), json.loads(body)


def ends(connection: socket.socket) -> bool:
    """Whether the service cuts the connection without a word."""
    try:
        return connection.recv(65536) == b""
    except ConnectionResetError:
        return True


def test_slow_headers_a_slow_body_and_silence_are_dismissed() -> None:
    with limited(Limits(head_s=0.3, body_s=0.3)) as service:
        slow_head, slow_body, silent = dial(service), dial(service), dial(service)
        slow_head.sendall(HEAD)
        slow_body.sendall(HEAD + b"Content-Length: 1000\r\n\r\n" + JPEG[:10])
        steady = dial(service)
        for part in (HEAD, b"Content-Length: %d\r\n\r\n" % len(JPEG), JPEG):
            steady.sendall(part)
        assert steady.recv(20).startswith(b"HTTP/1.1 200")
        for connection, what in ((slow_head, "headers"), (slow_body, "body")):
            status, problem = last_words(connection)
            assert (status, problem["type"]) == (408, "/problems/request-timeout")
            assert what in str(problem["detail"])
        assert ends(silent)
        assert service.post(JPEG).status == 200
        # A second request on an old connection has the same time.
        late = dial(service)
        late.sendall(HEAD + b"Content-Length: %d\r\n\r\n" % len(JPEG) + JPEG)
        assert late.recv(65536).startswith(b"HTTP/1.1 200")
        late.sendall(HEAD)
        assert last_words(late)[0] == 408


def test_a_byte_now_and_then_does_not_extend_the_time() -> None:
    with limited(Limits(head_s=0.4)) as service:
        connection = dial(service)
        connection.sendall(HEAD + b"X-Slow: ")
        begin, sent = time.monotonic(), True
        while sent and time.monotonic() < begin + 15:
            try:
                connection.sendall(b"a")
            except OSError:
                sent = False
            time.sleep(0.05)
        assert not sent


@contextmanager
def filled(count: int) -> Iterator[tuple[Served, list[socket.socket]]]:
    """A service with as many connections as it takes, each with an answer behind it."""
    with limited(Limits(connections=count)) as service:
        connections = [dial(service) for _ in range(count)]
        for connection in connections:
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert connection.recv(65536).startswith(b"HTTP/1.1 200")
        yield service, connections


def test_one_connection_too_many_is_told_so_and_room_is_made_again() -> None:
    with filled(4) as (service, connections):
        status, problem = last_words(dial(service))
        assert (status, problem["type"]) == (503, "/problems/too-many-connections")
        assert problem["retry_after_ms"] == 1000
        connections[0].close()
        until(lambda: Served(service.port).ask("GET", "/healthz").status == 200)


def test_connections_that_ask_for_nothing_make_room() -> None:
    with limited(Limits(connections=4)) as service:
        idle = [dial(service) for _ in range(4)]
        time.sleep(0.2)  # for half of that they could still have begun
        assert service.post(JPEG).status == 200
        assert ends(idle[0])


def test_slow_headers_and_bodies_make_room_but_not_who_is_served() -> None:
    with limited(Limits(connections=4)) as service:
        steady = dial(service)
        whole = HEAD + b"Content-Length: %d\r\n\r\n" % len(JPEG) + JPEG
        steady.sendall(whole)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")
        slow = [dial(service) for _ in range(3)]
        slow[0].sendall(HEAD + b"Content-Length: 1000\r\n\r\n" + JPEG[:10])
        for connection in slow[1:]:
            connection.sendall(HEAD)
        time.sleep(0.2)
        assert service.post(JPEG).status == 200
        assert [c for c in slow if _is_cut(c)] != []
        steady.sendall(whole)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")


def _is_cut(connection: socket.socket) -> bool:
    connection.settimeout(0.2)
    try:
        return ends(connection)
    except TimeoutError:
        return False


@pytest.mark.parametrize(
    "sent",
    [
        HEAD + b"X-Frame-Id: " + b"x" * 40_000 + b"\r\n\r\n",
        HEAD + b"X-Frame-Id: " + b"x" * 100_000,
        HEAD + b"".join(b"X-%d: %s\r\n" % (n, b"y" * 100) for n in range(500)) + b"\r\n",
        b"GET /" + b"x" * 40_000 + b" HTTP/1.1\r\n\r\n",
    ],
)
def test_headers_have_a_limit(service: Served, sent: bytes) -> None:
    connection = dial(service)
    for at in range(0, len(sent), 5000):
        try:
            connection.sendall(sent[at : at + 5000])
        except OSError:  # it has heard enough
            break
    status, problem = last_words(connection)
    assert (status, problem["type"]) == (431, "/problems/headers-too-large")
    assert service.post(JPEG).status == 200


def test_what_is_no_http_is_a_problem_too(service: Served) -> None:
    for sent in (b"hello\r\n\r\n", b"\x16\x03\x01\x02\x00" + bytes(50), b"GET / HTTP/9.9\r\n\r\n"):
        connection = dial(service)
        connection.sendall(sent)
        status, problem = last_words(connection)
        assert (status, problem["type"]) == (400, "/problems/malformed-request")


def test_only_who_knows_the_token_is_answered() -> None:
    token = "a-token-of-some-length"
    with limited(Limits(token=token)) as service:
        for sent in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {token}"}):
            for method, path in (
                ("POST", "/features"),
                ("GET", "/model"),
                ("GET", "/openapi.json"),
            ):
                reply = service.ask(method, path, JPEG, {"Content-Type": "image/jpeg", **sent})
                assert_problem(reply, 401, "unauthorized")
                assert reply.headers["www-authenticate"] == "Bearer"
        assert service.post(JPEG, Authorization=f"Bearer {token}").status == 200
        assert service.ask("GET", "/readyz").status == 200  # a balancer knows no token
        assert service.ask("GET", "/").status == 200  # the console asks for it
        assert service.ask("GET", "/docs").status == 200  # a browser can send none


def test_a_client_that_asks_too_often_is_told_when_to_come_back() -> None:
    memory = shared_memory.create_shared_memory(blocks=1)
    here = RateLimiter(memory.clients(), 10.0)
    there = RateLimiter(shared_memory.attach_shared_memory(memory.fd, 1).clients(), 10.0)
    now = 1000.0
    for number in range(10):
        (here, there)[number % 2].check("10.0.0.1", now)
    with pytest.raises(Problem) as caught:
        there.check("10.0.0.1", now)
    assert caught.value.type.status == 429
    assert caught.value.retry_after_ms == pytest.approx(100)
    assert caught.value.headers["Retry-After"] == "1"
    here.check("10.0.0.2", now)  # another client
    here.check("10.0.0.1", now + 0.11)
    for _ in range(1000):
        here.check("127.0.0.1", now)  # this machine
        RateLimiter(memory.clients(), 0.0).check("10.0.0.1", now)  # no limit


def test_which_addresses_are_this_machine() -> None:
    assert all(map(is_loopback, ["127.0.0.1", "127.8.8.8", "::1", "localhost", "::ffff:127.0.0.1"]))
    assert not any(
        map(is_loopback, ["0.0.0.0", "::", "10.0.0.1", "example.org", "", "::ffff:1.2.3.4"])
    )


def test_a_refused_client_is_paused_and_then_read_again() -> None:
    """While the queue is full its next request waits for a moment; nothing else does."""
    gate = Gate()
    with serving(gate.engine, limits=Limits(queue=0)) as service, ThreadPoolExecutor(1) as pool:
        first = pool.submit(Served(service.port).post, JPEG)
        until(gate.busy.is_set)
        for _ in range(20):
            assert_problem(service.post(JPEG), 503, "overloaded")
        assert service.ask("GET", "/healthz").status == 200
        gate.open.set()
        assert first.result().status == 200
        until(lambda: service.post(JPEG).status == 200)

"""Limits for clients: connections, time for a request, size of headers, token, request rate."""

import json
import select
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from serve import shared_memory
from serve.config import Limits
from serve.problems import Problem
from serve.scheduling.rate_limit import RateLimiter
from serve.server.guard import EVICTABLE_S, ConnectionGuard, Group
from tests.serve.attacks.conftest import read_rest
from tests.serve.conftest import (
    HEAD,
    JPEG,
    PATIENCE_S,
    WHOLE,
    Clock,
    Gate,
    Served,
    assert_problem,
    busy,
    serving,
    until,
)


def dial(service: Served, source: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", service.port), PATIENCE_S, (source, 0))


def read_refusal(connection: socket.socket) -> tuple[int, dict[str, object]]:
    """The status and the problem in the reply with which the service ends a connection."""
    with connection:
        head, _, body = read_rest(connection).partition(b"\r\n\r\n")
    assert b"connection: close" in head
    return int(head.split()[1]), json.loads(body)


def is_cut(connection: socket.socket) -> bool:
    """Whether the service ends the connection without a reply."""
    try:
        return connection.recv(65536) == b""
    except ConnectionResetError:
        return True


def test_slow_headers_slow_bodies_and_silent_connections_are_closed() -> None:
    clock = Clock()
    with serving(limits=Limits(head_s=5.0, body_s=10.0, idle_s=30.0), clock=clock) as service:
        slow_head, slow_body, silent = dial(service), dial(service), dial(service)
        begun = HEAD + b"Content-Length: 1000\r\n\r\n" + JPEG[:10]
        slow_head.sendall(HEAD)
        slow_body.sendall(begun)
        complete = dial(service)
        for part in (HEAD, b"Content-Length: %d\r\n\r\n" % len(JPEG), JPEG):
            complete.sendall(part)
        assert complete.recv(65536).startswith(b"HTTP/1.1 200")
        service.wait_received(0, len(HEAD), len(begun))
        clock.now_s += 5.1
        assert_too_slow(slow_head, "headers")
        assert is_cut(silent)
        assert service.received_bytes() == [len(begun)]
        clock.now_s += 5.0
        assert_too_slow(slow_body, "body")
        # The second request of a connection has the same time limit.
        complete.sendall(HEAD)
        service.wait_received(len(HEAD))
        clock.now_s += 5.1
        assert_too_slow(complete, "headers")
        assert service.post(JPEG).status == 200


def assert_too_slow(connection: socket.socket, part: str) -> None:
    status, problem = read_refusal(connection)
    assert (status, problem["type"]) == (408, "/problems/request-timeout")
    assert part in str(problem["detail"])


def test_single_bytes_do_not_extend_the_time_for_headers() -> None:
    clock, begun = Clock(), HEAD + b"X-Slow: "
    with serving(limits=Limits(head_s=5.0), clock=clock) as service:
        connection = dial(service)
        connection.sendall(begun)
        for count in range(4):
            service.wait_received(len(begun) + count)
            clock.now_s += 1.2  # 4.8 s in total
            connection.sendall(b"a")
        service.wait_received(len(begun) + 4)
        clock.now_s += 0.3
        assert_too_slow(connection, "headers")


@contextmanager
def filled(count: int) -> Iterator[tuple[Served, list[socket.socket]]]:
    """A service with its largest number of connections, each of which waits for an answer."""
    gate = Gate()
    with serving(gate.engine, limits=Limits(connections=count, queue=count)) as service:
        connections = [dial(service) for _ in range(count)]
        for connection in connections:
            connection.sendall(WHOLE)
        until(lambda: len(service.server.guard.working) == count)
        try:
            yield service, connections
        finally:
            gate.open.set()


def test_one_connection_too_many_is_refused_until_another_is_closed() -> None:
    with filled(4) as (service, connections):
        status, problem = read_refusal(dial(service))
        assert (status, problem["type"]) == (503, "/problems/too-many-connections")
        assert problem["retry_after_ms"] == 1000
        connections[0].close()
        until(lambda: len(service.server.server_state.connections) == 3)
        assert service.ask("GET", "/healthz").status == 200


def test_idle_connections_give_way_to_new_ones_longest_idle_first_served_clients_last() -> None:
    with serving(limits=Limits(connections=4)) as service:
        served, *idle = connections = [dial(service) for _ in range(4)]
        served.sendall(WHOLE)
        assert served.recv(65536).startswith(b"HTTP/1.1 200")
        for connection in (*idle, idle[0]):
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            received = b""
            while not received.endswith(b'{"status":"alive"}'):
                received += connection.recv(65536)
        new = []
        for expected in (idle[1], idle[2], idle[0]):
            new.append(dial(service))
            ended, _, _ = select.select(connections, [], [], PATIENCE_S)
            assert ended == [expected]
            assert is_cut(expected)
            connections.remove(expected)
            new[-1].sendall(
                b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\n\r\n"
            )
            until(lambda: len(service.server.guard.receiving) == len(new))  # not idle
            assert len(service.server.server_state.connections) <= 5
        served.sendall(WHOLE)
        assert served.recv(65536).startswith(b"HTTP/1.1 200")


def test_connections_without_a_request_give_way_to_new_ones() -> None:
    clock = Clock()
    with serving(limits=Limits(connections=4), clock=clock) as service:
        silent = [dial(service) for _ in range(4)]
        service.wait_received(0, 0, 0, 0)
        clock.now_s += 1.01 * EVICTABLE_S
        assert service.post(JPEG).status == 200
        assert is_cut(silent[0])


def test_a_client_with_many_connections_gives_way_to_one_with_few() -> None:
    clock = Clock()
    with serving(limits=Limits(connections=8), clock=clock) as service:
        steady = dial(service)
        steady.sendall(WHOLE)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")
        many = [dial(service, "127.0.0.2") for _ in range(7)]
        service.wait_received(*[0] * 7)
        assert read_refusal(dial(service, "127.0.0.2"))[0] == 503  # all are too young
        steady.sendall(WHOLE)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")
        others = [dial(service) for _ in range(2)]  # one replaces the refused connection
        for other in others:
            other.sendall(WHOLE)
            assert other.recv(65536).startswith(b"HTTP/1.1 200")
        ended, _, _ = select.select(many, [], [], PATIENCE_S)
        assert [is_cut(connection) for connection in ended] == [True]


def test_the_clients_of_a_trusted_proxy_are_many() -> None:
    guard = ConnectionGuard(Limits(trusted_proxies=("10.0.0.0/8",)))
    proxied, direct = (Connection(guard, address) for address in ("10.0.0.7", "192.0.2.1"))
    others = [Connection(guard, "10.0.0.7") for _ in range(9)]
    guard.place(proxied, guard.served)
    assert guard.make_room_for(direct, 1)
    assert proxied.ended
    for connection in (proxied, direct, *others):
        guard.forget(connection)
    assert not guard.open


def test_the_networks_of_ipv6_are_clients() -> None:
    guard = ConnectionGuard(Limits())
    for address in ("2001:db8::1", "2001:db8::2", "2001:db8:1::1", "::ffff:192.0.2.1", "192.0.2.1"):
        Connection(guard, address)
    assert sorted(guard.open.values()) == [1, 2, 2]


class Connection:
    """A connection from `address`, admitted by `guard`."""

    def __init__(self, guard: ConnectionGuard, address: str) -> None:
        self.since_s, self.network, self.ended = 0.0, "", False
        self.group: Group = {}
        guard.admit(self, (address, 50_000))

    def give_way(self) -> None:
        self.ended = True

    def expire(self, now: float) -> None:
        raise NotImplementedError

    def end_slow_body(self, now: float) -> int:
        raise NotImplementedError


def test_slow_requests_give_way_to_new_connections_but_served_clients_stay() -> None:
    clock = Clock()
    begun = HEAD + b"Content-Length: 1000\r\n\r\n" + JPEG[:10]
    with serving(limits=Limits(connections=4), clock=clock) as service:
        steady = dial(service)
        steady.sendall(WHOLE)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")
        slow = [dial(service) for _ in range(3)]
        for connection, part in zip(slow, (begun, HEAD, HEAD), strict=True):
            connection.sendall(part)
        service.wait_received(len(HEAD), len(HEAD), len(begun))
        clock.now_s += 1.01 * EVICTABLE_S
        assert service.post(JPEG).status == 200
        ended, _, _ = select.select(slow, [], [], PATIENCE_S)
        assert [is_cut(connection) for connection in ended] == [True]
        steady.sendall(WHOLE)
        assert steady.recv(65536).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "sent",
    [
        HEAD + b"X-Frame-Id: " + b"x" * 40_000 + b"\r\n\r\n",
        HEAD + b"X-Frame-Id: " + b"x" * 100_000,
        HEAD + b"".join(b"X-%d: %s\r\n" % (n, b"y" * 100) for n in range(500)) + b"\r\n",
        b"GET /" + b"x" * 40_000 + b" HTTP/1.1\r\n\r\n",
    ],
)
def test_headers_have_a_size_limit(service: Served, sent: bytes) -> None:
    connection = dial(service)
    for at in range(0, len(sent), 5000):
        try:
            connection.sendall(sent[at : at + 5000])
        except OSError:  # the service has refused it
            break
    status, problem = read_refusal(connection)
    assert (status, problem["type"]) == (431, "/problems/headers-too-large")
    assert service.post(JPEG).status == 200


def test_bytes_that_are_no_http_are_answered_with_a_problem(service: Served) -> None:
    for sent in (b"hello\r\n\r\n", b"\x16\x03\x01\x02\x00" + bytes(50), b"GET / HTTP/9.9\r\n\r\n"):
        connection = dial(service)
        connection.sendall(sent)
        status, problem = read_refusal(connection)
        assert (status, problem["type"]) == (400, "/problems/malformed-request")


def test_requests_without_the_token_are_refused() -> None:
    token = "a-token-of-some-length"
    with serving(limits=Limits(token=token)) as service:
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
        assert service.ask("GET", "/readyz").status == 200  # load balancers have no token
        assert service.ask("GET", "/").status == 200  # the console asks the user for the token
        assert service.ask("GET", "/docs").status == 200  # a browser cannot send a token


def test_a_client_over_its_rate_is_refused_with_a_retry_time() -> None:
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


def test_a_rate_below_one_a_second_lets_a_request_pass_now_and_then() -> None:
    limiter = RateLimiter(shared_memory.create_shared_memory(blocks=1).clients(), 0.5)
    limiter.check("10.0.0.1", 100.0)
    with pytest.raises(Problem, match=r"more than 0\.5 requests per second"):
        limiter.check("10.0.0.1", 101.0)
    limiter.check("10.0.0.1", 103.0)


def test_a_client_refused_by_a_full_queue_is_paused_and_then_read_again() -> None:
    """While the queue is full, the client's next request waits a moment; other clients do not."""
    with busy(limits=Limits(queue=0)) as (service, gate):
        for _ in range(20):
            assert_problem(service.post(JPEG), 503, "overloaded")
        assert service.ask("GET", "/healthz").status == 200
        gate.open.set()
        until(lambda: service.post(JPEG).status == 200)

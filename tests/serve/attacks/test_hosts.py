"""Requests from web pages, with foreign host names, through proxies, and from many addresses."""

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from typer.testing import CliRunner

from serve.api.access import HostCheck
from serve.cli import app
from serve.config import Limits, ServiceConfig, check_proxies, network_of
from serve.problems import Problem
from serve.scheduling.fair_queue import FairQueue
from serve.scheduling.overload import MAX_CLIENT_MS, Admission
from serve.scheduling.rate_limit import RateLimiter, client_key
from serve.scheduling.streams import stream_key
from serve.shared_memory import create_shared_memory
from serve.workers.worker_process import WorkerTask
from tests.serve.attacks.conftest import Target, read_head, read_rest, status_of
from tests.serve.conftest import JPEG, FakeEngine, Served, assert_problem, serving
from trackfeatures.errors import UserError

TOKEN = "0123456789abcdef"
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}
PATHS = (("POST", "/features"), ("POST", "/v2/models/track/infer"), ("GET", "/model"), ("GET", "/"))


@pytest.fixture
def guarded(engine: FakeEngine) -> Iterator[Served]:
    with serving(engine, limits=Limits(token=TOKEN)) as service:
        yield service


def raw(service: Served, request: bytes) -> tuple[int, bytes]:
    """The status and the body of the answer to the bytes of a request without a body."""
    with Target(service.port).dial() as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        received = read_rest(connection)
    return status_of(received), received.partition(b"\r\n\r\n")[2]


@pytest.mark.parametrize(("method", "path"), PATHS)
@pytest.mark.parametrize("host", ["evil.example", "localhost.evil.example", "10.0.0.1", "", "[::1"])
def test_a_rebound_name_is_refused_without_a_token(
    service: Served, method: str, path: str, host: str
) -> None:
    assert_problem(service.ask(method, path, JPEG, {"Host": host}), 403, "forbidden-host")


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:80", "127.0.0.1:8000", "127.9.9.9", "[::1]:8000", "localhost."]
)
def test_loopback_names_are_answered(service: Served, host: str) -> None:
    assert service.post(JPEG, Host=host).status == 200


def test_the_names_that_are_allowed_are_answered(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(hosts=("Cam.example", "10.1.2.3", "fd00::1"))) as service:
        for host in ("cam.example:8000", "CAM.EXAMPLE", "10.1.2.3", "[fd00::1]:8000", "localhost"):
            assert service.post(JPEG, Host=host).status == 200
        for host in ("example", "10.1.2.4", "[fd00::2]"):
            assert_problem(service.post(JPEG, Host=host), 403, "forbidden-host")


def test_a_service_on_all_addresses_answers_to_addresses_not_to_names(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(hosts=("0.0.0.0",))) as service:
        for host in ("192.168.1.7:8000", "[fd00::1]", "localhost"):
            assert service.post(JPEG, Host=host).status == 200
        assert_problem(service.post(JPEG, Host="evil.example"), 403, "forbidden-host")


def test_with_a_token_every_name_is_answered(guarded: Served) -> None:
    for host in ("serve:8000", "driverview.default.svc", "10.0.3.4:8000"):
        reply = guarded.ask("GET", "/metrics", headers={**AUTHORIZED, "Host": host})
        assert reply.status == 200
        assert guarded.ask("GET", "/metrics", headers={"Host": host}).status == 401


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/v2/health/live", "/v2/health/ready"])
def test_probes_come_by_any_name(service: Served, path: str) -> None:
    for host in ("10.0.3.4:8000", "driverview"):
        assert service.ask("GET", path, headers={"Host": host}).status == 200


@pytest.mark.parametrize("path", [b"/features", b"/healthz", b"/", b"/v2"])
@pytest.mark.parametrize("method", [b"GET", b"POST"])
def test_no_host_and_two_hosts_are_no_requests(
    service: Served, guarded: Served, method: bytes, path: bytes
) -> None:
    token = f"Authorization: Bearer {TOKEN}\r\n".encode()
    close = b"Content-Length: 0\r\nConnection: close\r\n\r\n"
    for hosts in (b"", b"Host: localhost\r\nHost: localhost\r\n", b"host: a\r\nHOST: b\r\n"):
        for served in (service, guarded):
            request = b"%b %b HTTP/1.1\r\n%b%b%b" % (method, path, hosts, token, close)
            status, body = raw(served, request)
            assert status == 400
            assert b"/problems/malformed-request" in body


def test_http_1_0_needs_no_host_where_a_token_is_asked_for(
    service: Served, guarded: Served
) -> None:
    request = b"GET /healthz HTTP/1.0\r\n\r\n"
    assert raw(guarded, request)[0] == 200
    assert raw(service, request)[0] == 400


ORIGINS = ["https://evil.example", "null", "http://[", "http://", "x", "http://localhost", "é"]


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize(("method", "path"), [*PATHS, ("GET", "/healthz")])
def test_pages_of_other_sites_are_refused_everywhere(
    service: Served, guarded: Served, method: str, path: str, origin: str
) -> None:
    for served in (service, guarded):
        headers = {**AUTHORIZED, "Origin": origin, "Content-Type": "text/plain"}
        assert_problem(served.ask(method, path, JPEG, headers), 403, "forbidden-origin")
        own = {**AUTHORIZED, "Origin": served.url.upper().replace("HTTP", "http")}
        assert served.ask("GET", "/model", headers=own).status == 200


def test_a_page_behind_a_proxy_that_changes_the_host(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(hosts=("cam.example",))) as service:
        assert service.post(JPEG, Origin="https://cam.example").status == 200
        assert service.post(JPEG, Origin="https://cam.example:8443").status == 200
        reply = service.post(JPEG, Origin="https://cam.example.evil")
        assert_problem(reply, 403, "forbidden-origin")


def test_allowed_hosts_may_be_given_with_a_port_a_final_dot_or_brackets() -> None:
    check = HostCheck(Limits(hosts=("Cam.example:8443", "other.example.", "[fd00::1]:80", "")))
    for host in (b"cam.example", b"cam.example:80", b"other.example", b"[fd00::1]"):
        check.check({b"host": host})
    with pytest.raises(Problem, match="does not accept"):
        check.check({b"host": b"evil.example"})


def test_a_missing_host_is_refused_also_after_http_1_0_sent_none() -> None:
    check = HostCheck(Limits(token=TOKEN))
    check.check({}, version="1.0")
    with pytest.raises(Problem, match="no Host header"):
        check.check({})


def test_a_64_is_one_client_and_ipv4_in_ipv6_is_ipv4() -> None:
    assert client_key("2001:db8::1") == client_key("2001:db8::ffff:2")
    assert client_key("2001:db8::1") != client_key("2001:db8:0:1::1")
    assert client_key("::ffff:10.0.0.1") == client_key("10.0.0.1") != client_key("10.0.0.2")
    assert client_key("fe80::1%eth0") == client_key("fe80::2%eth1")
    assert network_of("unix") == "unix"
    assert client_key("::1") == 0.0
    limiter = RateLimiter(create_shared_memory(1).clients(), 10.0)
    for number in range(10):
        limiter.check(f"2001:db8::{number:x}", 100.0)
    with pytest.raises(Problem, match="more than 10 requests"):
        limiter.check("2001:db8::a", 100.0)


def test_large_images_from_a_64_count_as_one_clients() -> None:
    admission = Admission(FairQueue())
    admission.admit("2001:db8::1", MAX_CLIENT_MS, 0)
    with pytest.raises(Problem, match="of this client"):
        admission.admit("2001:db8::2", MAX_CLIENT_MS, 0)
    admission.admit("2001:db8:0:1::1", MAX_CLIENT_MS, 0)
    waiting = FairQueue()
    for number in range(9):
        waiting.note(f"2001:db8::{number}", number)
    Admission(waiting).admit("2001:db8::a", 2 * MAX_CLIENT_MS, 9)()  # no other client is present


@pytest.fixture
def far(engine: FakeEngine) -> Iterator[Callable[..., int]]:
    """A function that sends a request from an address behind a proxy and returns the status; the
    rate limit is three requests per second."""
    limits = Limits(token=TOKEN, rate=3.0, trusted_proxies=("127.0.0.0/8", "10.0.0.0/8"))
    with serving(engine, limits=limits) as service:

        def ask(forwarded: str, path: str, **headers: str) -> int:
            sent = {"X-Forwarded-For": forwarded, **headers}
            return service.ask("POST" if path == "/features" else "GET", path, headers=sent).status

        yield ask


def burst(ask: Callable[..., int], forwarded: str, path: str) -> set[int]:
    return {ask(forwarded, path) for _ in range(40)}


def test_guesses_of_the_token_are_counted(far: Callable[..., int]) -> None:
    assert burst(far, "203.0.113.1", "/features") == {401, 429}


@pytest.mark.parametrize("path", ["/", "/healthz", "/docs", "/v2/health/live"])
def test_public_paths_are_counted_apart(far: Callable[..., int], path: str) -> None:
    assert burst(far, "203.0.113.1", "/features") == {401, 429}
    assert burst(far, "203.0.113.1", path) == {200, 429}


def test_behind_a_proxy_each_client_is_its_last_untrusted_address(far: Callable[..., int]) -> None:
    assert 429 in burst(far, "1.1.1.1, 203.0.113.1", "/model")
    # Addresses that the client writes have no effect; addresses of trusted proxies are skipped.
    assert 429 in {far(f"2.2.2.{n}, 203.0.113.1", "/model") for n in range(9)}
    assert 429 in {far(f"203.0.113.1, 10.0.0.{n}", "/model") for n in range(9)}
    assert far("203.0.113.2", "/model") == 401


def test_a_proxy_that_is_not_trusted_names_no_client(engine: FakeEngine) -> None:
    limits = Limits(rate=1.0, trusted_proxies=("192.0.2.1",))
    with serving(engine, limits=limits) as service:  # the requests come from 127.0.0.1
        replies = {service.post(JPEG, X_Forwarded_For="203.0.113.1").status for _ in range(5)}
        assert replies == {200}


@pytest.mark.parametrize(
    ("proxies", "forwarded"),
    [
        ((), "203.0.113.1"),
        (("127.0.0.1",), "203.0.113.1"),
        (("::ffff:127.0.0.1",), "203.0.113.1"),
        (("127.0.0.0/8",), "203.0.113.1, ::ffff:127.0.0.9"),  # through two proxies
    ],
)
def test_a_socket_for_ipv4_and_ipv6_trusts_a_proxy_on_ipv4(
    engine: FakeEngine, proxies: tuple[str, ...], forwarded: str
) -> None:
    """The socket of `--host ::` reports the address 127.0.0.1 as ::ffff:127.0.0.1."""
    limits = Limits(token=TOKEN, rate=2.0, trusted_proxies=check_proxies(proxies))
    with serving(engine, limits=limits, host="::") as service, ExitStack() as stack:
        target = Target(service.port, TOKEN)
        statuses = set()
        for _ in range(6):
            connection = stack.enter_context(target.dial())
            connection.sendall(target.handshake(X_Forwarded_For=forwarded))
            statuses.add(status_of(read_head(connection)))
        assert statuses == {101, 429}
        assert service.post(JPEG, X_Forwarded_For=forwarded).status == 429
        # Connections from a proxy that was given with --trusted-proxy are not counted together.
        assert set(service.server.guard.open) == (set() if proxies else {"127.0.0.1"})


def test_the_environment_makes_no_proxy_trusted(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "*")  # uvicorn's variable
    with serving(engine) as service:
        proxies = service.server.config.forwarded_allow_ips
        assert proxies == ["127.0.0.1", "::ffff:127.0.0.1/128"]


def test_proxies_are_addresses_or_networks() -> None:
    assert check_proxies(["10.0.0.1", "fd00::/8"]) == ("10.0.0.1", "fd00::/8")
    assert check_proxies(["::ffff:10.0.0.1", "::ffff:a00:0/104"]) == ("10.0.0.1/32", "10.0.0.0/8")
    for wrong in ("proxy.example", "10.0.0.1/8", "*", ""):
        with pytest.raises(UserError, match="--trusted-proxy is"):
            check_proxies([wrong])


def test_streams_of_two_clients_behind_a_proxy_do_not_touch() -> None:
    assert stream_key("203.0.113.1", "cam") != stream_key("203.0.113.2", "cam")


def test_the_options_reach_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    configs: list[ServiceConfig] = []
    monkeypatch.setattr("serve.launch.run", configs.append)
    monkeypatch.delenv("DRIVERVIEW_TOKEN", raising=False)
    words = "--allow-host a.example --allow-host b --trusted-proxy 10.0.0.0/8 --body-mib 8"
    assert CliRunner().invoke(app, words.split()).exit_code == 0
    limits = configs[0].limits
    assert limits.hosts == ("127.0.0.1", "a.example", "b")
    assert limits.trusted_proxies == ("10.0.0.0/8",)
    assert limits.body_mib == 8
    task = WorkerTask("run", 0, None, (3,), 4, 1, 0, limits)
    sent = WorkerTask.from_json_line(task.to_json_line().decode()).limits
    assert (tuple(sent.hosts), tuple(sent.trusted_proxies)) == (limits.hosts, ("10.0.0.0/8",))


@pytest.mark.parametrize(
    "words",
    ["--port 9000 reload", "--model new reload", "--insecure ray", "--token-file t restart"],
)
def test_options_before_a_subcommand_are_refused(words: str) -> None:
    error = CliRunner().invoke(app, words.split()).exception
    assert isinstance(error, UserError)
    assert str(error).startswith(f"{words.split()[0]} before `{words.split()[-1]}` has no effect")

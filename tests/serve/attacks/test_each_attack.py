"""Runs each attack that no other test runs; the service must still answer."""

import inspect

import pytest

from tests.serve.attacks import attacks, websockets
from tests.serve.attacks.conftest import Target, read_rest, resident_mb
from tests.serve.attacks.costs import REQUESTS, conflicting_lengths
from tests.serve.attacks.registry import ATTACKS, REPORTED
from tests.serve.conftest import JPEG, Served, until

OWN = 20
OTHERS = (
    *(attacks.pipelined_floods, attacks.refused_floods, websockets.deep_texts),
    *(websockets.long_texts, websockets.unread_answers, websockets.kept_messages),
    *(websockets.quiet_websockets, attacks.damaged_images),
)


def test_there_are_as_many_attacks_as_are_promised() -> None:
    names = [attack.__name__ for attack in ATTACKS]
    assert len(set(names)) == len(names)
    assert set(names) >= set(REPORTED)
    assert len(set(names) - set(REPORTED)) >= OWN
    for attack in ATTACKS:  # each has a count and a docstring
        assert len(inspect.signature(attack).parameters) >= 2
        assert attack.__doc__


@pytest.mark.parametrize("attack", [*REQUESTS, *OTHERS], ids=lambda attack: attack.__name__)
def test_the_service_answers_others(
    service: Served, target: Target, attack: attacks.Attack, caplog: pytest.LogCaptureFixture
) -> None:
    before = resident_mb()
    (count,) = list(inspect.signature(attack).parameters.values())[1:]
    connections = attack(target, max(count.default // 8, 4))  # type: ignore[call-arg]
    until(lambda: service.post(JPEG).status == 200)  # frames of the attack can still wait
    for connection in connections:
        connection.close()
    assert service.post(JPEG).status == 200
    until(lambda: resident_mb() - before < 200)  # of both sides: bodies in flight and sent bytes
    assert [r for r in caplog.records if r.levelname in ("WARNING", "ERROR")] == []


def test_a_length_that_can_be_read_in_two_ways_ends_the_connection(target: Target) -> None:
    """No second request is read from the body (RFC 9112, 6.3)."""
    for connection in conflicting_lengths(target, 5):
        connection.settimeout(30.0)
        received = read_rest(connection)
        assert received.startswith(b"HTTP/1.1 400")
        assert received.count(b"content-length:") == 1

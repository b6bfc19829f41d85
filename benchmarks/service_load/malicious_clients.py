"""Runs malicious clients against a service. They make all attacks of the tests, one after another,
once per minute.

They have a loopback address of their own, so that the service can distinguish them from other
clients.
"""

import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.synchronize import Event

from datagen.recorder.job import exit_with_parent
from tests.serve.attacks.attacks import Attack
from tests.serve.attacks.conftest import Target
from tests.serve.attacks.registry import ATTACKS

ADDRESS = "127.0.0.2"
ROUND_S = 60.0
START_S = 120.0
SPAWN = multiprocessing.get_context("spawn")
FORK = multiprocessing.get_context("fork")


@contextmanager
def malicious_clients(port: int) -> Iterator[None]:
    """Attack the service at `port` of this machine while the context lasts.

    The context begins with the first attack. Raises RuntimeError if no attack begins.
    """
    begun = SPAWN.Event()
    process = SPAWN.Process(target=attack_in_turn, args=(port, begun))
    process.start()
    try:
        if not begun.wait(START_S):
            raise RuntimeError("the bad clients do not begin")
        yield
    finally:
        process.terminate()
        process.join()


def attack_in_turn(port: int, begun: Event) -> None:
    """Repeat all attacks on the service at `port`; set `begun` at the first attack. Each attack has
    a process of its own, whose end closes the connections of the attack."""
    target = Target(port, source=ADDRESS)
    while True:
        for attack in ATTACKS:
            attacker = FORK.Process(target=make_and_hold, args=(attack, target, os.getpid()))
            attacker.start()
            begun.set()
            time.sleep(ROUND_S / len(ATTACKS))
            attacker.kill()
            attacker.join()


def make_and_hold(attack: Attack, target: Target, parent: int) -> None:
    """Make an attack and keep its connections open for a minute, or until the parent process (with
    the id `parent`) exits."""
    exit_with_parent(parent)
    held = []
    with suppress(OSError, AssertionError):  # the service refused it, which is correct
        held = attack(target)
    time.sleep(ROUND_S)
    for connection in held:
        connection.close()

"""Answers to a client when its car touches something and PyBullet is not installed."""

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from simulator.link.layout import COMMAND, STATE, Refusal, Request
from simulator.link.simulation import Simulation
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World

TEXT = b"contacts need PyBullet"


@pytest.fixture
def at_wall(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Simulation, Any]]:
    """A simulation at 20 Hz and its record, a few steps before the car touches the wall."""
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "simulator.world.physics", raising=False)
    record = np.zeros(1, STATE.dtype)[0]
    with World(Road(find_track("oval"))) as world:
        simulation = Simulation(world, record, np.zeros(0, np.uint8))
        simulation.answer(request(Request.RESET, start_angle=-1.2, start_speed=20.0))
        assert record["error"] == Refusal.NONE
        yield simulation, record


def request(kind: Request, **values: float) -> Any:
    row = np.zeros(1, COMMAND.dtype)[0]
    row["request"], row["gear"], row["start_s"] = kind, Command().gear, np.nan
    for name, value in values.items():
        row[name] = value
    return row


def test_a_contact_without_pybullet_closes_the_episode(at_wall: tuple[Simulation, Any]) -> None:
    simulation, record = at_wall
    while not record["error"] and record["step"] < 40:
        simulation.answer(request(Request.STEP))
    steps = int(record["step"])
    for _ in range(2):
        assert (record["error"], steps) == (Refusal.NO_EPISODE, record["step"])
        assert TEXT in bytes(record["error_text"])
        assert not simulation.running
        simulation.answer(request(Request.STEP))
    simulation.answer(request(Request.RESET))
    simulation.answer(request(Request.STEP))
    assert (record["error"], record["step"], simulation.running) == (Refusal.NONE, 1, True)


def test_in_real_time_too_and_the_server_goes_on(at_wall: tuple[Simulation, Any]) -> None:
    simulation, record = at_wall
    for _ in range(40):
        if simulation.running:  # as the server does
            simulation.advance()
    assert not simulation.running
    assert record["step"] < 40
    simulation.answer(request(Request.STEP))
    assert record["error"] == Refusal.NO_EPISODE
    assert TEXT in bytes(record["error_text"])
    simulation.end_episode()
    simulation.answer(request(Request.STEP))
    assert b"ask for a reset first" in bytes(record["error_text"])

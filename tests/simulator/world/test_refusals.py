"""Invalid arguments raise a UserError and leave the world unchanged."""

import math
from typing import Any

import pytest

from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World
from trackfeatures.errors import UserError

NAN, INF = math.nan, math.inf


def road(lanes: int = 1) -> Road:
    return Road(find_track("oval"), lanes)


@pytest.mark.parametrize("frequency", [0, -20, 30, 400, 0.5, 20.5, NAN])
def test_bad_control_rates_are_refused(frequency: Any) -> None:
    with pytest.raises(UserError, match="does not divide the physics"):
        World(road(), frequency_hz=frequency)


@pytest.mark.parametrize("count", [-1, 13, 10_000])
def test_bad_traffic_counts_are_refused(count: int) -> None:
    with pytest.raises(UserError, match=r"takes 0 to 12; ask for fewer"):
        World(road(), traffic=count)


@pytest.mark.parametrize("count", [2.5, "3", None, True])
def test_traffic_counts_that_are_not_integers_are_refused(count: Any) -> None:
    with pytest.raises(UserError, match="give a whole number"):
        World(road(), traffic=count)


@pytest.mark.parametrize("lanes", [0, -1, 4, 100])
def test_bad_lane_counts_are_refused(lanes: int) -> None:
    with pytest.raises(UserError, match="lane"):
        road(lanes)


@pytest.mark.parametrize("width", [0.0, 2.6, 4.6, NAN])
def test_bad_lane_widths_are_refused(width: float) -> None:
    with pytest.raises(UserError, match="lane"):
        Road(find_track("oval"), 1, width)


@pytest.mark.parametrize(
    ("what", "match"),
    [
        ({"seed": -1}, "seed = -1; give a whole number"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"seed": None}, "seed = None"),
        ({"s": NAN}, "s = nan"),
        ({"s": INF}, "s = inf"),
        ({"to_middle": NAN}, "to_middle = nan"),
        ({"to_middle": 40.0}, "the road ends"),
        ({"angle": -INF}, "angle = -inf"),
        ({"speed": NAN}, "speed = nan"),
        ({"speed": 151.0}, "speed = 151"),
    ],
)
def test_bad_starts_are_refused(what: dict[str, Any], match: str) -> None:
    with World(road()) as world:
        with pytest.raises(UserError, match=match):
            world.reset(**({"seed": 0} | what))
        with pytest.raises(UserError, match="call reset"):
            world.step(Command())
        before = world.reset(seed=0, speed=5.0)
        with pytest.raises(UserError, match=match):
            world.reset(**({"seed": 0} | what))
        assert world.state == before  # the episode goes on
        assert world.step(Command()).time_s == pytest.approx(0.05)


@pytest.mark.parametrize(
    "command",
    [
        Command(steer=NAN),
        Command(steer=-1.0001),
        Command(throttle=INF),
        Command(throttle=-0.1),
        Command(brake=NAN),
        Command(brake=1.1),
        Command(gear=7),
        Command(gear=-2),
        Command(gear=NAN),  # type: ignore[arg-type]
        Command(gear=1.5),  # type: ignore[arg-type]
        Command(gear=INF),  # type: ignore[arg-type]
    ],
)
def test_bad_commands_are_refused(command: Command) -> None:
    with World(road(), traffic=2) as world:
        before = world.reset(seed=0)
        places = world.traffic.poses().tobytes()
        with pytest.raises(UserError, match="the command has"):
            world.step(command)
        assert world.state == before
        assert world.traffic.poses().tobytes() == places


def test_use_before_the_first_reset_is_refused() -> None:
    with World(road()) as world:
        for use in (world.features, world.body_pose, lambda: world.state):
            with pytest.raises(UserError, match="call reset"):
                use()


def test_commands_beyond_a_bound_by_the_rounding_of_float32_are_clipped() -> None:
    states = []
    for beyond in (0.0, 1e-6):
        with World(road()) as world:
            world.reset(seed=0, speed=10.0)
            world.step(Command(-1.0 - beyond, 1.0 + beyond, -beyond, 2))
            states.append(world.step(Command(1.0 + beyond, -beyond, 1.0 + beyond, 2)))
    assert states[0] == states[1]
    with World(road()) as world:
        world.reset(seed=0)
        with pytest.raises(UserError, match=r"steer = 1\.00001, throttle = 0"):
            world.step(Command(steer=1.00001))

"""The cars of a training: the states of a drive, disturbances, episodes, starts."""

from typing import Any

import numpy as np
import pytest

from controllers.interface import Observation
from controllers.laws.actor_state import PAPER, STATES, StateBuilder, StateDefinition, paper_state
from controllers.rl import cars as module
from controllers.rl import privileged
from controllers.rl.cars import PERCEIVED, Cars, random_cars
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.world.world import World

HALF_WIDTH_M = 5.5
STEERS = np.sin(np.arange(40) / 5.0).astype(np.float32) / 10.0
START = {"s": 300.0, "to_middle": -1.0, "angle": 0.05, "speed": 12.0}


def oval(count: int, disturbed: bool = False, **changes: Any) -> Cars:
    """`count` cars on the oval, from one start."""
    given: dict[str, Any] = {
        "starts": START,
        "episode": (100, 100),
        "half_width_m": HALF_WIDTH_M,
    } | changes
    definition: StateDefinition = given.pop("definition", PAPER)
    return Cars(definition, ["oval"] * count, np.full(count, disturbed), **given)


def steered(cars: Cars, steers: np.ndarray = STEERS) -> np.ndarray:
    """The states (T + 1, N, size) of a drive with these actions."""
    states = [cars.reset(4)]
    states += [cars.step(np.full(cars.count, steer, np.float32)).states for steer in steers]
    cars.close()
    return np.array(states)


@pytest.mark.parametrize("name", ["paper", "history"])
def test_the_states_are_those_of_a_drive(name: str) -> None:
    """Bit for bit those that `controllers drive` builds from the world."""
    found = steered(oval(2, definition=STATES[name]))
    world = World(Road(find_track("oval")))
    world.reset(seed=0, **START)
    builder = StateBuilder(STATES[name])
    for k in range(len(found)):
        now = world.state
        seen = Observation(
            *(now.to_middle, now.angle, world.features().heading),
            *(now.vx, now.vy, now.yaw_rate),
        )
        expected = builder.build(paper_state(seen, HALF_WIDTH_M), seen)
        np.testing.assert_array_equal(found[k, 0], expected)
        np.testing.assert_array_equal(found[k, 1], expected)
        if k < len(STEERS):
            world.step(Command(steer=float(STEERS[k]), throttle=0.2, gear=1))
    world.close()


@pytest.fixture
def nominal(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Disturbed cars that are as the others; a test sets what it looks at."""
    for name, value in (
        *(("FRICTION", (1.0, 1.0)), ("MASS", (1.0, 1.0)), ("THROTTLES", (0.2, 0.2))),
        *(("DELAYS", 1), ("OFFSET_NOISE_M", 0.0), ("ANGLE_NOISE_RAD", 0.0)),
        ("SPEED_NOISE_M_S", 0.0),
    ):
        monkeypatch.setattr(module, name, value)
    return monkeypatch


def test_the_road_is_seen_late_and_the_speed_at_once(nominal: pytest.MonkeyPatch) -> None:
    exact = steered(oval(1))[:, 0]
    nominal.setattr(module, "DELAYS", 3)
    late = steered(oval(16, disturbed=True))
    road = np.isin(np.arange(7), PERCEIVED)
    delays = set()
    for car in range(16):
        np.testing.assert_array_equal(late[:, car, ~road], exact[:, ~road])
        fits = [
            d
            for d in range(3)
            if np.array_equal(late[3:, car, 0], exact[3 - d : len(exact) - d, 0])
        ]
        delays |= set(fits)
        assert len(fits) == 1
        seen = np.vstack([exact[:1]] * fits[0] + [exact])[: len(exact)]
        np.testing.assert_array_equal(late[:, car][:, road], seen[:, road])
    assert delays == {0, 1, 2}


def test_noise_has_the_spread_of_the_disturbance(nominal: pytest.MonkeyPatch) -> None:
    """Each car draws a share of it, uniform from 0 to 1, whose mean square is 1 / 3."""
    nominal.setattr(module, "OFFSET_NOISE_M", 0.05)
    nominal.setattr(module, "ANGLE_NOISE_RAD", 0.005)
    exact = steered(oval(1))
    noisy = steered(oval(150, disturbed=True))
    errors = noisy - exact
    stds = errors.std(axis=0)
    assert stds[:, 0].min() < 0.01 * 0.05 < 0.9 * 0.05 / HALF_WIDTH_M < stds[:, 0].max()
    size = errors.std(axis=(0, 1))
    assert size[0] == pytest.approx(0.05 / HALF_WIDTH_M / 3**0.5, rel=0.15)
    assert size[1] == pytest.approx(0.005 / np.pi / 3**0.5, rel=0.15)
    assert not errors[:, :, 2:].any()


def test_errors_of_images_last_for_several_steps_and_spare_disturbed_cars(
    nominal: pytest.MonkeyPatch,
) -> None:
    """The errors of offset and angle have their spread and correlations; they go on in an episode
    and begin anew with the next."""
    exact = steered(oval(1, episode=(20, 20)))
    cars = oval(400, image_errors=True, episode=(20, 20))
    errors = (steered(cars) - exact)[:, :, :2] * (HALF_WIDTH_M, np.pi)
    assert errors.std(axis=(0, 1)) == pytest.approx(module.IMAGE_ERRORS, rel=0.05)
    offset, angle = (errors / module.IMAGE_ERRORS).transpose(2, 0, 1)
    assert (offset * angle).mean() == pytest.approx(module.IMAGE_ERROR_CORRELATION, abs=0.05)
    kept = (offset[1:] * offset[:-1]).mean(axis=1)
    assert kept[:19].mean() == pytest.approx(module.IMAGE_ERROR_KEPT, abs=0.05)
    assert abs(kept[19]) < 0.2  # the first step of a new episode
    assert not (steered(oval(2, image_errors=True)) - steered(oval(1)))[:, :, 2:].any()
    disturbed = steered(oval(2, disturbed=True, image_errors=True))
    np.testing.assert_array_equal(disturbed[:, 0], steered(oval(1))[:, 0])


def test_the_noise_of_disturbed_cars_is_not_added_to_errors_of_images() -> None:
    half = np.arange(400) % 2 == 0
    cars = Cars(
        PAPER,
        ["oval"] * 400,
        half,
        starts=START,
        episode=(100, 100),
        half_width_m=HALF_WIDTH_M,
        image_errors=True,
    )
    errors = (steered(cars) - steered(oval(1)))[:, ~half] * ([HALF_WIDTH_M, np.pi] + [1.0] * 5)
    assert errors[:, :, :2].std(axis=(0, 1)) == pytest.approx(module.IMAGE_ERRORS, rel=0.05)
    assert not errors[:, :, 2:].any()


@pytest.mark.parametrize(
    ("name", "value"), [("FRICTION", (0.5, 0.5)), ("MASS", (1.5, 1.5)), ("THROTTLES", (0.3, 0.3))]
)
def test_disturbed_cars_are_other_cars(
    nominal: pytest.MonkeyPatch, name: str, value: tuple[float, float]
) -> None:
    same = steered(oval(1, disturbed=True))
    np.testing.assert_array_equal(same, steered(oval(1)))
    nominal.setattr(module, name, value)
    assert not np.array_equal(steered(oval(1, disturbed=True)), same)


def test_episodes_end_after_their_steps_and_begin_anew() -> None:
    cars = oval(8, episode=(5, 9), definition=STATES["history"])
    first = cars.reset(1)
    lengths = np.zeros(8, int)
    ages = np.zeros(8, int)
    for _ in range(30):
        step = cars.step(np.zeros(8, np.float32))
        ages += 1
        assert not step.ended.any()
        np.testing.assert_array_equal(step.states[~step.over], step.last[~step.over])
        np.testing.assert_array_equal(step.states[step.over], first[step.over])
        assert np.abs(step.last[step.over, 7:]).any(axis=1).all()
        lengths[step.over], ages[step.over] = ages[step.over], 0
    assert lengths.min() >= 5
    assert lengths.max() <= 9
    assert len(set(lengths.tolist())) > 1
    cars.close()


def test_a_car_off_the_road_ends_its_episode_and_the_others_go_on() -> None:
    cars = oval(2, starts=START | {"to_middle": [6.9, 0.0], "angle": -0.3})
    cars.reset(1)
    step = cars.step(np.zeros(2, np.float32))
    while not step.ended.any():
        step = cars.step(np.array([1.0, 0.0], np.float32))
    assert step.ended.tolist() == step.over.tolist() == [True, False]
    assert step.rewards[0] == -2.0 < 0.5 < step.rewards[1]
    assert step.offsets_m[0] > 7.0
    assert step.states[0, 0] == pytest.approx(6.9 / HALF_WIDTH_M, abs=0.01)
    cars.close()


def test_the_quadratic_reward() -> None:
    cars = oval(1, reward="quadratic")
    cars.reset(1)
    step = cars.step(np.array([0.1], np.float32))
    angle, offset = float(step.states[0, 1]) * np.pi, float(step.offsets_m[0])
    lock = 0.1 * 0.36652
    assert step.rewards[0] == pytest.approx(
        -(0.3 * offset**2 + angle**2 + 0.03 * lock**2), rel=1e-3
    )
    cars.close()


def test_cars_are_spread_over_tracks_random_roads_and_disturbances() -> None:
    cars = random_cars(PAPER, 12, ["oval", "town"], 0.5, half_width_m=HALF_WIDTH_M)
    cars.reset(2)
    names = [cars._envs.world(number).road.track.name for number in range(12)]
    assert names[::2] == ["oval", "town"] * 3
    assert all(name.startswith("random:") for name in names[1::2])
    assert len(set(names[1::2])) > 3
    assert cars._disturbed.sum() == 6
    assert cars._disturbed[::2].sum() == cars._disturbed[1::2].sum() == 3
    cars.close()


def test_the_privileged_state_is_the_truth_before_and_after_a_step() -> None:
    """The critic's numbers are those of the world, however late and noisy the actor's are."""
    cars = oval(6, disturbed=True, starts=START | {"s": (0.0, 1400.0)}, episode=(8, 12))
    cars.reset(3)
    before, over = None, np.zeros(6, np.bool_)
    drawn = set()
    for k in range(25):
        step = cars.step(np.full(6, 0.1 * np.sin(k), np.float32))
        if before is not None:
            np.testing.assert_array_equal(step.privileged[~over], before[~over])
            assert (step.privileged[over] != before[over]).any(axis=1).all()
        over, before = step.over, step.last_privileged
        for number in np.flatnonzero(~over).tolist():
            world = cars._envs.world(number)
            now, road, car = world.state, world.road, world.car
            exact = dict(zip(privileged.PARTS, before[number] * privileged.SPREAD, strict=True))
            assert exact["d"] == pytest.approx(now.to_middle, abs=1e-5)
            assert exact["angle"] == pytest.approx(now.angle, abs=1e-6)
            speeds = (exact["v_x"], exact["v_y"], exact["yaw_rate"])
            assert speeds == pytest.approx((now.vx, now.vy, now.yaw_rate), abs=1e-5)
            assert exact["steering"] == pytest.approx(0.1 * np.sin(k), abs=1e-6)
            assert exact["half_width"] == pytest.approx(road.half_width)
            curvatures = [road.track.curvature(now.s + far) for far in privileged.AHEAD_M]
            found = [exact[f"curvature_{far:g}"] for far in privileged.AHEAD_M]
            assert found == pytest.approx(curvatures, abs=1e-7)
            assert exact["mass"] == pytest.approx(car.mass / 1150.0 - 1.0, abs=1e-5)
            assert exact["friction"] == pytest.approx(car.friction / 1.6 - 1.0, abs=1e-5)
            assert 0.0 <= exact["throttle"] <= 0.1
            assert 0.0 <= exact["noise"] <= 1.0
            drawn.add((round(exact["delay"]), any(curvatures)))
    cars.close()
    assert {delay for delay, _ in drawn} == {0, 1, 2}
    assert {bend for _, bend in drawn} == {True, False}

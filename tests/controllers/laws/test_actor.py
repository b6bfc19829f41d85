"""Actors: their files, refusals, their state, and the shipped actors."""

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import simulator.env  # noqa: F401 registers the environment
from controllers.drive.closed_loop import run_lap
from controllers.interface import LoopConfig, Observation
from controllers.laws.actor import (
    SHIPPED,
    Actor,
    ActorCard,
    ActorError,
    load_actor,
    mirror_of,
    save_actor,
)
from controllers.laws.actor_state import (
    PAPER,
    RESIDUAL,
    STACKED,
    STATES,
    StateBuilder,
    find_state,
    paper_state,
)
from controllers.laws.lqr import Lqr
from controllers.laws.rl import RlController, load_controller
from controllers.perception.sources import truth
from controllers.registry import make_controller
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from tests.typed import error_line, typed
from trackfeatures import RoadClass
from trackfeatures.errors import UserError

SHA_256 = {
    "rl": "b11940a2a1735817b3ba6053f0393ed44afcae687f189351fca6357391c663ad",
    "rl-residual": "e7c30c5a1f0bc12b982b5a29b7ba8ad2f41a1c07b06243328d7922453dafffd3",
}
BOUNDS_M = {"rl": 0.5, "rl-residual": 0.5}
"""Largest distance from the centre in the drive of the test."""

SEEN = Observation(0.5, -0.1, RoadClass.RIGHT, vx=15.0, vy=-0.2, yaw_rate=0.3)


def an_actor(**changes: Any) -> Actor:
    """A random actor of the paper's state."""
    rng = np.random.default_rng(0)
    card = ActorCard(
        state="paper",
        parts=PAPER.parts,
        half_width_m=5.0,
        divisor=(1.0,) * 7,
        odd=False,
        hidden=(6, 5),
        algorithm="ddpg",
        track="oval",
        seed=0,
        step=10,
        score_per_step=0.5,
    )
    shapes = {"w1": (7, 6), "b1": (6,), "w2": (6, 5), "b2": (5,), "w3": (5,), "b3": (1,)}
    card = replace(card, **changes)
    shapes["w1"] = (len(card.parts), 6)
    weights = {n: rng.normal(size=s).astype(np.float32) for n, s in shapes.items()}
    return Actor(card, weights)


def test_the_state_is_the_environments() -> None:
    env = gym.make("driverview/LateralControl-v0", track="circuit")
    start = {"s": 300.0, "to_middle": 0.7, "angle": 0.05, "speed": 14.0}
    expected, _ = env.reset(seed=0, options=start)
    world = env.unwrapped.world  # type: ignore[attr-defined]
    now, heading = world.state, world.features().heading
    seen = Observation(now.to_middle, now.angle, heading, now.vx, now.vy, now.yaw_rate)
    np.testing.assert_array_equal(paper_state(seen, world.road.half_width), expected)
    env.close()


def test_the_stacked_state_holds_the_changes_and_the_last_actions() -> None:
    states = StateBuilder(STACKED)
    first = states.build(paper_state(SEEN, 5.0), SEEN)
    named = dict(zip(STACKED.parts, first.tolist(), strict=True))
    assert named["d"] == pytest.approx(0.1)
    assert named["turn"] == -1.0
    assert named["yaw_rate"] == pytest.approx(0.3)
    assert named["d_change"] == named["steer_1"] == 0.0
    assert (states.steer(0.4), states.steer(-0.2)) == (0.4, -0.2)
    second = states.build(paper_state(replace(SEEN, to_lane_centre=0.6), 5.0), SEEN)
    named = dict(zip(STACKED.parts, second.tolist(), strict=True))
    assert named["d_change"] == pytest.approx(0.02)
    assert named["angle_change"] == 0.0
    assert (named["steer_1"], named["steer_2"]) == pytest.approx((-0.2, 0.4))


def test_the_residual_is_added_to_lqr() -> None:
    states, lqr = StateBuilder(RESIDUAL), Lqr()
    for action, reached in ((0.0, 0.0), (0.5, 0.15), (-1.0, -0.3)):
        state = states.build(paper_state(SEEN, 5.0), SEEN)
        steer = lqr.update(SEEN)
        assert state[-1] == pytest.approx(steer)
        assert states.steer(action) == pytest.approx(max(-1.0, min(steer + reached, 1.0)))


@pytest.mark.parametrize("name", list(STATES))
def test_a_mirrored_state_is_that_of_the_mirrored_road(name: str) -> None:
    definition = find_state(name)
    mirrored = Observation(-0.5, 0.1, RoadClass.LEFT, vx=15.0, vy=0.2, yaw_rate=-0.3)
    state, other = (
        StateBuilder(definition).build(paper_state(seen, 5.0), seen) for seen in (SEEN, mirrored)
    )
    assert len(definition.spread) == len(definition.odd) == definition.size == len(state)
    assert np.array_equal(
        state[list(definition.order)] * np.array(definition.odd, np.float32), other
    )


def test_an_actor_is_two_relu_layers_and_tanh() -> None:
    actor = an_actor()
    state = np.linspace(0.0, 0.9, 7, dtype=np.float32)
    of = {n: a.astype(np.float64) for n, a in actor.weights.items()}
    hidden = np.maximum(np.maximum(state @ of["w1"] + of["b1"], 0) @ of["w2"] + of["b2"], 0)
    assert actor.steer(state) == pytest.approx(np.tanh(hidden @ of["w3"] + of["b3"])[0], abs=1e-6)
    divided = np.asarray(state / np.array(PAPER.spread), np.float32)
    assert an_actor(divisor=PAPER.spread).steer(state) == pytest.approx(
        actor.steer(divided), abs=1e-4
    )
    order, signs = mirror_of(PAPER)
    mirrored = np.asarray(state[order] * signs, np.float32)
    half = 0.5 * (actor.steer(state) - actor.steer(mirrored))
    assert an_actor(odd=True).steer(state) == pytest.approx(half, abs=1e-6)


def test_an_actor_is_read_as_it_was_written(tmp_path: Path) -> None:
    actor = an_actor(divisor=PAPER.spread)
    save_actor(tmp_path, actor)
    read = load_actor(tmp_path)
    assert read.card == actor.card
    assert all(np.array_equal(read.weights[n], a) for n, a in actor.weights.items())


def change_card(**values: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "actor.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


def change_weights(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        weights = load_file(folder / "actor.safetensors")
        change(weights)
        save_file(weights, folder / "actor.safetensors")

    return apply


WRONG = {
    "another state": (change_card(parts=("d", "speed")), "trained on the state d, speed"),
    "an unknown state": (change_card(state="pixels"), "no state 'pixels'"),
    "another version": (change_card(definitions_version="1"), "version"),
    "another format": (change_card(format=9), "format 9"),
    "no width": (change_card(half_width_m=0.0), "half_width_m 0.0"),
    "too few divisors": (change_card(divisor=(1.0, 2.0)), "each of 7"),
    "words for numbers": (change_card(divisor=["a"] * 7), "cannot be read"),
    "a card of another program": (change_card(colour="red"), "cannot be read"),
    "no card's text": (lambda f: (f / "actor.json").write_text("[1"), "cannot be read"),
    "a list as card": (lambda f: (f / "actor.json").write_text("[1]"), "cannot be read"),
    "no weights": (lambda f: (f / "actor.safetensors").unlink(), "cannot be read"),
    "torn weights": (
        lambda f: (f / "actor.safetensors").write_bytes(b"\x10" * 40),
        "cannot be read",
    ),
    "weights of another size": (
        change_weights(lambda w: w.update(w1=np.zeros((9, 6), np.float32))),
        "of shapes",
    ),
    "a missing layer": (change_weights(lambda w: w.pop("b2")), "of shapes"),
    "NaN": (change_weights(lambda w: w["w2"].fill(np.nan)), "not finite"),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_weights_are_refused_in_one_line(tmp_path: Path, case: str) -> None:
    change, message = WRONG[case]
    save_actor(tmp_path, an_actor())
    change(tmp_path)
    with pytest.raises(Exception, match=message) as caught:
        load_actor(tmp_path)
    done = typed("controllers", "drive", "--controller", tmp_path, "--track", "oval")
    assert done.returncode == 1
    error_line(done)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, ActorError) or "version" in message or "pixels" in message


@pytest.mark.parametrize("name", list(SHA_256))
def test_the_shipped_weights_are_those_of_the_page(name: str) -> None:
    content = (SHIPPED / name / "actor.safetensors").read_bytes()
    assert hashlib.sha256(content).hexdigest() == SHA_256[name]
    assert len(content) < 50_000


@pytest.mark.parametrize("name", list(SHA_256))
@pytest.mark.parametrize("track", ["circuit", "mountain-pass"])
def test_a_shipped_actor_drives_tracks_it_was_not_trained_on(name: str, track: str) -> None:
    world = World(Road(find_track(track), lanes=1), frequency_hz=20)
    world.reset(seed=0)
    result = run_lap(world, load_controller(SHIPPED / name), truth(0.0), 3000)
    world.close()
    assert (result.ended, result.steps) == (None, 3000)
    assert result.max_abs_d_m < BOUNDS_M[name]


@pytest.mark.parametrize("name", list(SHA_256))
def test_a_shipped_actor_is_refused_at_another_rate(name: str) -> None:
    shipped = load_controller(SHIPPED / name)
    assert make_controller(name, LoopConfig(0.05)).update(SEEN) == shipped.update(SEEN)
    with pytest.raises(UserError, match=rf"{name} was trained for steps of 0\.05 s, not 0\.1"):
        make_controller(name, LoopConfig(0.1))


def test_a_shipped_actor_gets_no_curvature() -> None:
    """An actor receives the same information as the paper's; the curvature does not change it."""
    for name in SHA_256:
        without, given = (
            load_controller(SHIPPED / name).update(replace(SEEN, curvature=c)) for c in (None, 0.05)
        )
        assert without == given


def test_driving_needs_no_torch_and_no_compiler() -> None:
    program = (
        "import sys; from controllers.laws.rl import make_rl; "
        "from controllers.interface import LoopConfig as L, Observation as O; "
        "print(make_rl(L(0.05)).update(O(.1, 0., 1, 15., 0., 0.)), "
        "[m for m in ('torch', 'numba', 'gymnasium', 'pybullet') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.rstrip().endswith("[]")


@pytest.mark.alone
@pytest.mark.parametrize("name", list(SHA_256))
def test_an_update_takes_less_than_a_tenth_of_a_millisecond(name: str) -> None:
    controller = load_controller(SHIPPED / name)

    def median_s() -> float:
        taken = []
        for _ in range(2000):
            start = time.perf_counter()
            controller.update(SEEN)
            taken.append(time.perf_counter() - start)
        return float(np.median(taken))

    assert min(median_s() for _ in range(5)) < 1e-4  # another program may disturb a round


def test_two_controllers_of_one_actor_do_not_share_their_past() -> None:
    actor = an_actor(state="stacked", parts=STACKED.parts, divisor=STACKED.spread)
    first, second = RlController(actor), RlController(actor)
    steers = [first.update(SEEN) for _ in range(3)]
    assert steers[1] != steers[0]
    assert second.update(SEEN) == steers[0]

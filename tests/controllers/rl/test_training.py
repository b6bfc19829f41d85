"""Training: exploration, replay, a resumed training that gives the same bits, the command."""

import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.laws.actor import load_actor
from controllers.laws.actor_state import PAPER, STACKED, STATES
from controllers.rl.agent import Agent, Replay
from controllers.rl.config import ALGORITHMS, TrainConfig, exploration_share
from controllers.rl.training import train
from simulator.track.catalogue import OWN_TRACKS
from tests.typed import error_line, typed
from trackfeatures.errors import UserError


def short(out: Path, **changes: Any) -> TrainConfig:
    """A training of a few seconds."""
    config = TrainConfig(out=out, track="oval", steps=1500, evaluate_every=600, algorithm="td3")
    return replace(config, **changes)


def read_curve(run: Path) -> Any:
    """The columns of a training's curve, by name."""
    return np.genfromtxt(run / "curve.csv", delimiter=",", names=True)


def test_exploration_falls_to_a_tenth_over_400000_steps() -> None:
    assert exploration_share(0) == 1.0
    assert exploration_share(200_000) == pytest.approx(0.55)
    assert exploration_share(400_000) == pytest.approx(0.1)
    assert exploration_share(10**7) == 0.1


def test_the_settings_of_ddpg_are_the_papers() -> None:
    ddpg = ALGORITHMS["ddpg"]
    assert (ddpg.discount, ddpg.state_noise, ddpg.tau, ddpg.batch) == (0.99, 0.05, 0.001, 64)
    assert (ddpg.critics, ddpg.actor_delay, ddpg.target_noise) == (1, 1, 0.0)
    assert (ddpg.random_starts, ddpg.mirrored, ddpg.scaled) == (False, False, False)
    assert (ddpg.reward_baseline, ddpg.reward_scale) == (0.0, 1.0)


def test_the_replay_keeps_the_last_transitions() -> None:
    replay = Replay(3, 2)
    for k in range(5):
        replay.add(np.full(2, k, np.float32), k, 10.0 * k, np.full(2, -k, np.float32), k == 4)
    assert len(replay) == 3
    batch = replay.sample(np.arange(3))
    assert sorted(batch.actions.tolist()) == [2.0, 3.0, 4.0]
    at = batch.actions.tolist().index(4.0)
    assert (batch.rewards[at], batch.ended[at]) == (40.0, 1.0)
    assert batch.states[at].tolist() == [4.0, 4.0]
    assert batch.next_states[at].tolist() == [-4.0, -4.0]


def test_a_terminal_state_costs_the_baseline_for_ever() -> None:
    """A baseline shifts the return of a terminal state and of driving on by the same number."""
    td3 = replace(ALGORITHMS["td3"], reward_scale=1.0)
    agent = Agent(td3, PAPER, 0)
    seen = np.zeros(7, np.float32)
    agent.remember(seen, 0.0, -2.0, seen, True)
    agent.remember(seen, 0.0, 0.75, seen, False)
    ended, on = agent.replay.results[:2, 1]
    assert on == -0.25
    # Without a baseline the return of the end is -2; 1 subtracted a step for ever shifts it.
    assert ended == pytest.approx(-2.0 - 1.0 / (1.0 - td3.discount))


@pytest.mark.parametrize("name", list(STATES))
def test_an_actor_of_td3_is_odd(name: str) -> None:
    definition = STATES[name]
    agent = Agent(ALGORITHMS["td3"], definition, 3)
    state = np.random.default_rng(1).normal(size=definition.size).astype(np.float32)
    mirrored = state[list(definition.order)] * np.array(definition.odd, np.float32)
    assert agent.act(agent.see(state)) == -agent.act(agent.see(mirrored)) != 0.0


def test_mirrored_transitions_are_those_of_the_mirrored_road() -> None:
    agent = Agent(ALGORITHMS["td3"], STACKED, 0)
    state = np.arange(1.0, 11.0, dtype=np.float32)
    agent.remember(state, 0.5, 0.9, state + 1, False)
    batch = agent.replay.sample(np.array([0, 0]))
    agent._mirror(batch, np.array([True, False]))
    assert batch.actions.tolist() == [-0.5, 0.5]
    assert batch.states[1].tolist() == state.tolist()
    assert batch.states[0].tolist() == [-1, -2, 3, -4, -5, -6, -7, -8, -9, -10]
    assert batch.next_states[0, 2] == 4.0


GOLDEN = {
    # Losses of the first and the 40th update, an action, sums of the absolute parameters.
    "ddpg": (0.344524, 0.360488, -0.0167356, (358.93695, 358.24844, 361.78189, 360.45319)),
    "td3": (811.14625, 772.4165, 0.0163913, (359.44373, 358.27277, 735.79144, 715.5995)),
}
"""From commit df7eed5, before trainings with many cars."""


@pytest.mark.parametrize("name", list(GOLDEN))
def test_40_updates_give_the_numbers_of_before(name: str) -> None:
    agent, rng = Agent(ALGORITHMS[name], PAPER, 0), np.random.default_rng(1)
    for _ in range(200):
        state, after = rng.normal(0, 0.3, (2, 7)).astype(np.float32)
        action, reward = rng.uniform(-1, 1), rng.uniform(-1, 1)
        agent.remember(agent.see(state), action, reward, agent.see(after), bool(rng.random() < 0.1))
    losses = [agent.update(rng, 1.0) for _ in range(40)]
    asked = np.array([0, 0.3, 0, 0, 0, 0, 0], np.float32)
    sizes = [
        float(np.abs(getattr(of, part)).sum())
        for of in (agent.actor, agent.critics)
        for part in ("theta", "target")
    ]
    first, last, action, expected = GOLDEN[name]
    assert (losses[0], losses[-1]) == pytest.approx((first, last), rel=1e-4)
    assert agent.act(agent.see(asked)) == pytest.approx(action, rel=1e-3)
    assert sizes == pytest.approx(expected, rel=1e-5)
    rows = np.stack((asked, -2.0 * asked))
    assert agent.act_all(agent.see(rows)) == pytest.approx(
        [agent.act(agent.see(row)) for row in rows], abs=1e-6
    )


@pytest.mark.parametrize(
    "state",
    [
        "paper",
        pytest.param("stacked", marks=pytest.mark.extended),
        "residual",
        pytest.param("history", marks=pytest.mark.extended),
    ],
)
def test_a_stopped_training_resumes_to_the_same_bits(tmp_path: Path, state: str) -> None:
    whole = train(short(tmp_path / "whole", state=state))

    def stop(step: int, best: float) -> None:
        if step == 1000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(short(tmp_path / "parts", state=state), stop)
    stopped = (tmp_path / "parts" / "curve.csv").read_text().splitlines()
    parts = train(short(tmp_path / "parts", state=state))

    assert len(stopped) == 2
    assert parts["steps"] == whole["steps"] == 1500
    assert parts["best_score_per_step"] == whole["best_score_per_step"]
    for name in ("actor.safetensors", "actor.json"):
        first, second = (tmp_path / run / name for run in ("whole", "parts"))
        assert first.read_bytes() == second.read_bytes()
    curves = [read_curve(tmp_path / run) for run in ("whole", "parts")]
    for column in ("step", "loss", "score_per_step", "max_abs_d_m"):
        np.testing.assert_array_equal(curves[0][column], curves[1][column])


@pytest.mark.extended
def test_a_training_learns_to_stay_on_the_road(tmp_path: Path) -> None:
    """The first drive leaves the road early, later drives do not (seeds 0 to 3 reach 0.94)."""
    train(short(tmp_path, steps=16_000, seed=2, evaluate_every=1000))
    scores = read_curve(tmp_path)["score_per_step"]
    assert scores[0] < 0.3
    assert scores.max() > 0.9


def test_the_quadratic_reward_chooses_and_trains(tmp_path: Path) -> None:
    runs = {
        reward: train(short(tmp_path / reward, reward=reward)) for reward in ("paper", "quadratic")
    }
    actors = [(tmp_path / reward / "actor.safetensors").read_bytes() for reward in runs]
    assert actors[0] != actors[1]
    scores = read_curve(tmp_path / "quadratic")["score_per_step"]
    assert runs["quadratic"]["best_score_per_step"] == max(scores) < 0.0
    assert load_actor(tmp_path / "quadratic").card.reward == "quadratic"
    with pytest.raises(UserError, match="there is no reward 'cubic'"):
        train(short(tmp_path / "cubic", reward="cubic"))


def test_a_run_without_a_stored_reward_is_continued(tmp_path: Path) -> None:
    train(short(tmp_path, steps=200))
    path = tmp_path / "config.json"
    content = json.loads(path.read_text())
    del content["reward"]
    path.write_text(json.dumps(content))
    assert train(short(tmp_path, steps=200))["steps"] == 200


def test_a_training_on_a_changed_track_is_not_continued(tmp_path: Path) -> None:
    track, out = tmp_path / "mine.toml", tmp_path / "run"
    text = (OWN_TRACKS / "oval.toml").read_text()
    track.write_text(text)
    config = short(out, track=str(track), steps=20, evaluate_every=20)
    train(config)
    track.write_text(re.sub(r'^surface = ".*"$', 'surface = "gravel"', text, flags=re.M))
    for resume in (False, True):
        with pytest.raises(UserError, match="was started on other roads: track mine has changed"):
            train(replace(config, resume=resume))
    path = out / "config.json"
    content = json.loads(path.read_text())
    assert content.pop("roads").keys() == {"mine"}
    path.write_text(json.dumps(content))  # as earlier versions wrote it
    train(config)


def test_another_seed_gives_another_actor(tmp_path: Path) -> None:
    for seed in (1, 2):
        train(short(tmp_path / str(seed), seed=seed, steps=1100, algorithm="ddpg"))
    first, second = ((tmp_path / s / "actor.safetensors").read_bytes() for s in "12")
    assert first != second


def test_a_run_of_other_options_is_not_continued(tmp_path: Path) -> None:
    train(short(tmp_path / "run", steps=200))
    with pytest.raises(UserError, match="another seed, steps"):
        train(short(tmp_path / "run", steps=300, seed=7))


def test_a_moved_run_is_continued_and_keeps_its_file(tmp_path: Path) -> None:
    train(short(tmp_path / "run", steps=200))
    kept = (tmp_path / "run" / "config.json").read_bytes()
    (tmp_path / "run").rename(tmp_path / "moved")
    assert train(short(tmp_path / "moved", steps=200))["steps"] == 200
    assert (tmp_path / "moved" / "config.json").read_bytes() == kept


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_a_damaged_configuration_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(UserError, match=r"config.json cannot be read"):
        train(short(tmp_path, steps=200))


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    train(short(tmp_path / "run", steps=200))
    path = tmp_path / "run" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"checkpoint .* cannot be read"):
        train(short(tmp_path / "run", steps=200))


def test_the_command_trains_and_drives(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = typed(
        *("controllers", "train", "--algorithm", "td3", "--track", "oval", "--steps", "300"),
        *("--out", out, "--json"),
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == 300
    driven = typed(
        *("controllers", "drive", "--controller", out, "--track", "oval", "--steps", "20"), "--json"
    )
    assert driven.returncode == 0, driven.stderr
    assert json.loads(driven.stdout)["steps"] == 20


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--algorithm", "sarsa"), "no algorithm 'sarsa'; use one of: ddpg, td3, ppo"),
        (("--state", "pixels"), "no state 'pixels'; use one of: paper, stacked, residual, history"),
        (("--track", "nowhere"), "no track 'nowhere'"),
        (("--state-noise", "-1"), "noise is -1"),
        (("--actor-rate", "0"), "learning rate 0.0"),
        (("--algorithm", "ppo", "--state", "residual"), "--state residual needs --envs 1"),
        (("--algorithm", "td3", "--envs", "8", "--state", "stacked"), "--state stacked needs"),
        (("--track", "all"), "--track all needs several cars"),
        (("--track", "random"), "--track random gives no fixed road"),
        (("--algorithm", "ppo", "--envs", "2", "--track", "nowhere"), "no track 'nowhere'"),
        (("--algorithm", "ppo", "--actor-rate", "nan"), "learning rate nan"),
        (("--algorithm", "ppo", "--state-noise", "-1", "--track", "oval"), "noise is -1"),
        (("--resume",), "run holds no training"),
    ],
)
def test_a_wrong_option_is_one_error_line(
    tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    done = typed("controllers", "train", "--out", tmp_path / "run", *words)
    assert done.returncode == 1
    assert message in error_line(done)
    assert not (tmp_path / "run").exists()


@pytest.mark.extended
@pytest.mark.slow
def test_ctrl_c_leaves_a_run_that_continues(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["controllers", "train", "--track", "oval", "--steps", "3000", "--algorithm", "td3"]
    words += ["--evaluate-every", "500", "--out", str(out)]
    command = [sys.executable, "-m", *words]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (out / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode in (0, 130), error
    assert "Traceback" not in error
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["steps"] == 3000

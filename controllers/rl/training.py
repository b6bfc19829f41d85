"""Training of an actor in the Gymnasium environment; drives choose the best actor. SI units.

controllers train --algorithm td3 --track forza --seed 0 --out runs/rl

The random numbers of an episode depend only on the seed and the episode's number, and checkpoints
are written between episodes. So a resumed training gives the same actor as an uninterrupted one.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import gymnasium as gym
import numpy as np

import simulator.env  # noqa: F401 registers the environment
from controllers.drive.closed_loop import DriveResult, check_reward, run_lap
from controllers.drive.run import FREQUENCY_HZ, steps_for
from controllers.interface import Observation
from controllers.laws.actor import Actor, ActorCard, save_actor
from controllers.laws.actor_state import StateBuilder, find_state
from controllers.laws.rl import RlController
from controllers.perception.sources import truth
from controllers.rl.agent import Agent
from controllers.rl.checkpoint import Progress, load_checkpoint, save_checkpoint
from controllers.rl.config import (
    EXPLORATION_NOISE,
    QUADRATIC_SCALE,
    Algorithm,
    TrainConfig,
    exploration_share,
    find_algorithm,
)
from controllers.rl.networks import layers
from runtime.files import atomic_write, locked_folder, write_json
from simulator.env.reward import quadratic_reward
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.errors import UserError

PAPER_EPISODE_STEPS, RANDOM_EPISODE_STEPS = 6500, 400
"""Steps of an episode from the paper's start, and with `random_starts`."""
PAPER_STARTS = 0.1
"""Share of the episodes that begin at the paper's start with `random_starts`."""
CONFIG, CURVE = "config.json", "curve.csv"
COLUMNS = ("step", "seconds", "episodes", "loss", "score_per_step", "mean_abs_d_m", "max_abs_d_m")

Report = Callable[[int, float], None]
"""A function that is called with the number of finished steps and the best score per step so far,
which is -inf before the first drive."""


def train(config: TrainConfig, report: Report | None = None) -> dict[str, Any]:
    """Train as `config` describes, from the checkpoint of the run if it has one.

    Writes the best actor (by the drives on the training track), `curve.csv` and `config.json` into
    `config.out`. Raises UserError for an unknown name, or a run of another configuration.
    """
    algorithm = _settings(config)
    find_state(config.state)
    options: dict[str, Any] = {"noise": algorithm.state_noise, "tracks_dir": config.tracks_dir}
    env = gym.make(
        "driverview/LateralControl-v0", track=config.track, disable_env_checker=True, **options
    )
    try:
        _prepare_folder(config)
        with locked_folder(config.out):
            return _Training(config, algorithm, env, report).run()
    finally:
        env.close()


def _settings(config: TrainConfig) -> Algorithm:
    """The settings of the algorithm, with the changes of `config`."""
    check_reward(config.reward)
    algorithm = find_algorithm(config.algorithm)
    if config.reward == "quadratic":
        scale = QUADRATIC_SCALE * algorithm.reward_scale
        algorithm = replace(algorithm, reward_baseline=0.0, reward_scale=scale)
    given = {name: getattr(config, name) for name in ("state_noise", "actor_rate", "critic_rate")}
    algorithm = replace(algorithm, **{n: value for n, value in given.items() if value is not None})
    for rate in (algorithm.actor_rate, algorithm.critic_rate):
        if not 0.0 < rate < math.inf:
            raise UserError(f"the learning rate {rate} is out of range; give one above 0")
    return algorithm


def _prepare_folder(config: TrainConfig) -> None:
    """Make the folder of the run, or check that it contains a run of the same configuration."""
    path = config.out / CONFIG
    content = json.loads(json.dumps(asdict(config), default=str))
    if path.exists():
        try:
            found = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise UserError(f"{path} cannot be read ({error}); give another --out") from error
        found = asdict(TrainConfig()) | found  # runs made before `reward` existed lack it
        # `out` is not compared, because the folder may have been moved.
        changed = [n for n in content if n != "out" and found.get(n) != content[n]]
        if changed:
            raise UserError(
                f"{config.out} holds a training with another {', '.join(changed)}; give another "
                "--out, or the same options to continue it"
            )
        return
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(path, content)


class _Training:
    """The state of one training between episodes."""

    def __init__(
        self,
        config: TrainConfig,
        algorithm: Algorithm,
        env: gym.Env[Any, Any],
        report: Report | None,
    ) -> None:
        self._config, self._algorithm, self._env, self._report = config, algorithm, env, report
        self._state = find_state(config.state)
        self._agent = Agent(algorithm, self._state, config.seed)
        self._progress = load_checkpoint(config.out, self._agent) or Progress()
        self._world: World = env.unwrapped.world  # type: ignore[attr-defined]
        self._started = time.monotonic() - self._progress.seconds

    def run(self) -> dict[str, Any]:
        progress, config = self._progress, self._config
        while progress.step < config.steps:
            self._episode()
            last = progress.step >= config.steps
            if last or progress.step - progress.evaluated >= config.evaluate_every:
                self._evaluate()
                save_checkpoint(config.out, self._agent, progress)
        return {
            "out": str(config.out),
            "steps": progress.step,
            "episodes": progress.episode,
            "seconds": round(progress.seconds, 1),
            "best_step": progress.best_step,
            "best_score_per_step": progress.best_score,
        }

    def _episode(self) -> None:
        """One episode; each step is followed by an update once the replay has `learning_starts`
        transitions."""
        progress, algorithm, agent = self._progress, self._algorithm, self._agent
        rng = np.random.default_rng([self._config.seed, 1, progress.episode])
        paper, _ = self._env.reset(seed=int(rng.integers(2**31)), options=self._start(rng))
        states = StateBuilder(self._state)
        seen = agent.see(states.build(paper, self._observe()))
        limit = RANDOM_EPISODE_STEPS if algorithm.random_starts else PAPER_EPISODE_STEPS
        losses: list[float] = []
        for _ in range(min(limit, self._config.steps - progress.step)):
            action = self._explore(agent.act(seen), rng)
            steer = np.array([states.steer(action)], np.float32)
            paper, reward, ended, _, _ = self._env.step(steer)
            if self._config.reward == "quadratic":
                now = self._world.state
                reward = quadratic_reward(now.to_middle, now.angle, float(steer[0]), ended)
            next_seen = agent.see(states.build(paper, self._observe()))
            agent.remember(seen, action, float(reward), next_seen, ended)
            seen = next_seen
            progress.step += 1
            if len(agent.replay) >= algorithm.learning_starts:
                losses.append(agent.update(rng, self._rate_share()))
            if self._report is not None and progress.step % 100 == 0:
                self._report(progress.step, progress.best_score)
            if ended:
                break
        progress.episode += 1
        progress.loss = float(np.mean(losses)) if losses else float("nan")
        progress.seconds = time.monotonic() - self._started

    def _observe(self) -> Observation:
        """The observation of a controller on the truth, without the noise on the state."""
        now = self._world.state
        heading = self._world.features().heading
        return Observation(now.to_middle, now.angle, heading, now.vx, now.vy, now.yaw_rate)

    def _start(self, rng: np.random.Generator) -> dict[str, float]:
        """Options of the reset: {} for the paper's start, or a random place and motion."""
        if not self._algorithm.random_starts or rng.random() < PAPER_STARTS:
            return {}
        return {
            "s": rng.uniform(0.0, self._world.road.track.length_m),
            "to_middle": float(np.clip(rng.normal(0.0, 0.7), -2.0, 2.0)),
            "angle": float(np.clip(rng.normal(0.0, 0.08), -0.3, 0.3)),
            "speed": rng.uniform(0.0, 22.0),
        }

    def _explore(self, action: float, rng: np.random.Generator) -> float:
        """`action` with the paper's noise, which is added with the probability of this step."""
        if rng.random() < exploration_share(self._progress.step):
            action += self._algorithm.beta * EXPLORATION_NOISE * rng.standard_normal()
        return min(max(action, -1.0), 1.0)

    def _rate_share(self) -> float:
        done = self._progress.step / self._config.steps
        return 1.0 - (1.0 - self._algorithm.rate_end) * done

    def _evaluate(self) -> None:
        """Drive the training track without noise; save the actor if it is the best so far."""
        progress, config = self._progress, self._config
        actor = self._actor(0.0)
        result = _drive(actor, self._world.road)
        score = result.per_step(config.reward)
        if score > progress.best_score:
            progress.best_score, progress.best_step = score, progress.step
            save_actor(config.out, self._actor(score))
        progress.evaluated = progress.step
        progress.seconds = time.monotonic() - self._started
        progress.curve.append(
            (
                progress.step,
                round(progress.seconds, 1),
                progress.episode,
                progress.loss,
                score,
                result.mean_abs_d_m,
                result.max_abs_d_m,
            )
        )
        rows = [COLUMNS, *progress.curve]
        text = "\n".join(",".join(map(str, row)) for row in rows)
        atomic_write(config.out / CURVE, text + "\n")

    def _actor(self, score: float) -> Actor:
        """The target actor: an average over the last updates, which steers more smoothly."""
        agent, algorithm, config = self._agent, self._algorithm, self._config
        weights = {
            name: array[0].reshape(-1) if name[0] == "b" else array[0]
            for name, array in layers(agent.actor.target.copy(), agent.shape)._asdict().items()
        }
        card = ActorCard(
            state=config.state,
            parts=self._state.parts,
            half_width_m=self._world.road.half_width,
            divisor=tuple(agent.divisor.tolist()),
            odd=algorithm.mirrored,
            hidden=algorithm.hidden,
            algorithm=config.algorithm,
            track=config.track,
            seed=config.seed,
            step=self._progress.step,
            score_per_step=score,
            reward=config.reward,
        )
        return Actor(card, weights | {"w3": weights["w3"][:, 0]})


def _drive(actor: Actor, road: Road) -> DriveResult:
    """The result of the drive that `controllers drive` makes on the truth."""
    world = World(road, frequency_hz=FREQUENCY_HZ)
    try:
        world.reset(seed=0)
        steps = steps_for(None, road.track.name, road.track.length_m)
        return run_lap(world, RlController(actor), truth(0.0), steps)
    finally:
        world.close()

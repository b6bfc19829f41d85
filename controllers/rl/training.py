"""Trains an actor with one car and keeps the actor with the best drive. SI units.

controllers train --algorithm td3 --track forza --seed 0 --out runs/rl

The random numbers of an episode depend only on the seed and the episode's number, and checkpoints
are written between episodes. So a resumed training gives the same actor as an uninterrupted one.
Trainings with many cars are in `vector_training`.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import simulator.env  # noqa: F401 registers the environment
from controllers.drive.closed_loop import DriveResult, check_reward, run_lap
from controllers.drive.run import FREQUENCY_HZ, steps_for
from controllers.interface import Observation
from controllers.laws.actor import Actor, ActorCard
from controllers.laws.actor_state import StateBuilder, find_state
from controllers.laws.rl import RlController
from controllers.perception.sources import truth
from controllers.rl.agent import Agent
from controllers.rl.config import (
    ALL_TRACKS,
    EXPLORATION_NOISE,
    Algorithm,
    TrainConfig,
    exploration_share,
    find_settings,
    resolve,
)
from controllers.rl.run_folder import RunFolder, prepare_folder
from runtime.files import locked_folder
from simulator.env.reward import quadratic_reward
from simulator.track.random_roads.road import RANDOM
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.errors import UserError

PAPER_EPISODE_STEPS, RANDOM_EPISODE_STEPS = 6500, 400
"""Number of steps of an episode without and with the setting `random_starts`."""
PAPER_STARTS = 0.1
"""Share of the episodes that begin at the paper's start if `random_starts` is set. All other
episodes begin at a random position and speed."""

Report = Callable[[int, float], None]
"""A function that is called with the number of finished steps and the best score per step so far,
which is -inf before the first drive."""


def train(config: TrainConfig, report: Report | None = None) -> dict[str, Any]:
    """Train as `config` describes, from the checkpoint of the run if it has one; returns the
    figures that `controllers train` prints.

    Writes the actor with the best evaluation, the curves of the training and `config.json` into
    `config.out`.
    Raises UserError for an unknown name, or a run of another configuration.
    """
    config = resolve(config)
    check_reward(config.reward)
    settings = find_settings(config)
    find_state(config.state)
    if config.vectorised:
        from controllers.rl.vector_training import train_vector

        return train_vector(config, settings, report)
    assert isinstance(settings, Algorithm)
    if config.track == ALL_TRACKS:
        raise UserError("--track all needs several cars; give --envs, for example 256")
    if config.track == RANDOM:
        raise UserError(
            f"--track {RANDOM} gives no fixed road for the evaluations; give one random road, for "
            "example random:7, or several cars (--envs 256), half of which drive on random roads"
        )
    options: dict[str, Any] = {"noise": settings.state_noise, "tracks_dir": config.tracks_dir}
    env = gym.make(
        "driverview/LateralControl-v0", track=config.track, disable_env_checker=True, **options
    )
    try:
        world: World = env.unwrapped.world  # type: ignore[attr-defined]
        prepare_folder(config, [world.road.track])
        with locked_folder(config.out):
            return _Training(config, settings, env, report).run()
    finally:
        env.close()


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
        assert config.steps is not None
        assert config.evaluate_every is not None
        self._steps, self._evaluate_every = config.steps, config.evaluate_every
        self._state = find_state(config.state)
        self._agent = Agent(algorithm, self._state, config.seed)
        self._folder = RunFolder(config.out, self._agent)
        self._progress = self._folder.progress
        self._world: World = env.unwrapped.world  # type: ignore[attr-defined]

    def run(self) -> dict[str, Any]:
        progress = self._progress
        with self._folder:
            while progress.step < self._steps:
                self._episode()
                last = progress.step >= self._steps
                if last or progress.step - progress.evaluated >= self._evaluate_every:
                    self._evaluate()
        return self._folder.result()

    def _episode(self) -> None:
        """Run one episode. An update follows each step once the replay has `learning_starts`
        transitions."""
        progress, algorithm, agent = self._progress, self._algorithm, self._agent
        rng = np.random.default_rng([self._config.seed, 1, progress.episode])
        paper, _ = self._env.reset(seed=int(rng.integers(2**31)), options=self._start(rng))
        states = StateBuilder(self._state)
        seen = agent.see(states.build(paper, self._observe()))
        limit = RANDOM_EPISODE_STEPS if algorithm.random_starts else PAPER_EPISODE_STEPS
        losses: list[float] = []
        for _ in range(min(limit, self._steps - progress.step)):
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
        self._folder.tick()

    def _observe(self) -> Observation:
        """Return the exact observation of the present step, without the noise on the state."""
        now = self._world.state
        heading = self._world.features().heading
        return Observation(now.to_middle, now.angle, heading, now.vx, now.vy, now.yaw_rate)

    def _start(self, rng: np.random.Generator) -> dict[str, float]:
        """Return the options of the environment's reset: {} for the paper's start, else a random
        position and speed."""
        if not self._algorithm.random_starts or rng.random() < PAPER_STARTS:
            return {}
        return {
            "s": rng.uniform(0.0, self._world.road.track.length_m),
            "to_middle": float(np.clip(rng.normal(0.0, 0.7), -2.0, 2.0)),
            "angle": float(np.clip(rng.normal(0.0, 0.08), -0.3, 0.3)),
            "speed": rng.uniform(0.0, 22.0),
        }

    def _explore(self, action: float, rng: np.random.Generator) -> float:
        """Return `action` with the paper's noise, whose probability falls during the training."""
        if rng.random() < exploration_share(self._progress.step):
            action += self._algorithm.beta * EXPLORATION_NOISE * rng.standard_normal()
        return min(max(action, -1.0), 1.0)

    def _rate_share(self) -> float:
        done = self._progress.step / self._steps
        return 1.0 - (1.0 - self._algorithm.rate_end) * done

    def _evaluate(self) -> None:
        """Drive the training track without noise; keep the actor if it is the best so far."""
        result = _drive(self._actor(0.0), self._world.road)
        score = result.per_step(self._config.reward)
        self._folder.add_evaluation(
            score, result.mean_abs_d_m, result.max_abs_d_m, self._actor(score)
        )

    def _actor(self, score: float) -> Actor:
        """Return the target actor. It is an average of the actor over the last updates, and steers
        more smoothly than the actor itself."""
        agent, algorithm, config = self._agent, self._algorithm, self._config
        assert config.track is not None
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
        return Actor(card, agent.weights())


def _drive(actor: Actor, road: Road) -> DriveResult:
    """Drive `actor` on the true state, as `controllers drive` does by default."""
    world = World(road, frequency_hz=FREQUENCY_HZ)
    try:
        world.reset(seed=0)
        steps = steps_for(None, road.track.name, road.track.length_m)
        return run_lap(world, RlController(actor), truth(0.0), steps)
    finally:
        world.close()

"""Trains an actor with many cars in a vector environment. SI units.

controllers train --algorithm ppo --envs 256 --out runs/ppo

After each evaluation all cars begin new episodes, whose random numbers depend only on the seed and
the number of evaluations. So a resumed training gives the same actor as an uninterrupted one.
"""

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from controllers.drive.run import GRID_SHARE
from controllers.laws.actor import Actor, ActorCard
from controllers.laws.actor_state import HISTORY, PAPER, StateDefinition, find_state
from controllers.rl.cars import Array, Cars, Step, random_cars
from controllers.rl.checkpoint import Learner
from controllers.rl.config import ALL_TRACKS, Algorithm, PpoSettings, TrainConfig
from controllers.rl.off_policy import OffPolicy
from controllers.rl.run_folder import RunFolder, prepare_folder
from runtime.files import locked_folder
from simulator.env.reward import OFF_TRACK_REWARD
from simulator.track.catalogue import find_track, list_tracks
from trackfeatures.errors import UserError

EVALUATION_STEPS = 6500
"""Control steps of an evaluation's drive on each track, from TORCS's first grid position."""
HALF_WIDTH_M = 5.5
"""Divisor of the offset in a training on all tracks: half the width of forza."""
Report = Callable[[int, float], None]


class VectorLearner(Learner, Protocol):
    """A learner that drives N cars at once."""

    horizon: int
    """Number of steps of each car in a batch of an update. The number of steps between two
    evaluations is a multiple of it."""
    divisor: Array
    odd: bool

    def act(self, states: Array) -> Array: ...

    def explore(self, states: Array, rng: np.random.Generator) -> Array: ...

    def learn(
        self, states: Array, actions: Array, step: Step, rng: np.random.Generator, left: float
    ) -> dict[str, float]: ...

    def weights(self) -> dict[str, Array]: ...


def train_vector(
    config: TrainConfig, settings: Algorithm | PpoSettings, report: Report | None = None
) -> dict[str, Any]:
    """Train as `config` describes, from the checkpoint of the run if it has one; return the figures
    that `controllers train` prints.

    `config` is a result of `resolve`, `settings` of `find_settings`. Raises UserError for an
    unknown track, a state that is not supported with several cars, or a run of another
    configuration.
    """
    definition = find_state(config.state)
    if definition.name not in (PAPER.name, HISTORY.name):
        raise UserError(
            f"--state {config.state} needs --envs 1 and ddpg or td3; several cars have the state "
            f"{PAPER.name} or {HISTORY.name}"
        )
    if not (math.isfinite(settings.state_noise) and settings.state_noise >= 0.0):
        raise UserError(f"noise is {settings.state_noise}; give a standard deviation of 0 or more")
    learner = _learner(config, settings, definition)
    training = _Training(config, settings, definition, learner, report)
    try:
        prepare_folder(config, training.tracks)
        with locked_folder(config.out):
            return training.run()
    finally:
        training.close()


def _learner(
    config: TrainConfig, settings: Algorithm | PpoSettings, definition: StateDefinition
) -> VectorLearner:
    assert config.envs is not None
    if isinstance(settings, Algorithm):
        return OffPolicy(settings, definition, config.seed)
    if find_spec("torch") is None:
        raise UserError("ppo needs torch: pip install 'driverview[training]'")
    import torch

    from controllers.rl.ppo import Ppo

    torch.set_num_threads(1)  # its own threads would wait busily on the cores that move the cars
    return Ppo(settings, definition, config.envs, config.seed, config.threads)


class _Training:
    """The state of one training between evaluations."""

    def __init__(
        self,
        config: TrainConfig,
        settings: Algorithm | PpoSettings,
        definition: StateDefinition,
        learner: VectorLearner,
        report: Report | None,
    ) -> None:
        assert config.envs is not None
        assert config.steps is not None
        assert config.evaluate_every is not None
        assert config.track is not None
        self._config, self._settings, self._definition = config, settings, definition
        self._learner, self._report = learner, report
        self._steps, self._evaluate_every, self._track = (
            *(config.steps, config.evaluate_every),
            config.track,
        )
        folder = config.tracks_dir
        found = (
            list_tracks(folder) if self._track == ALL_TRACKS else [find_track(self._track, folder)]
        )
        self.tracks = found
        whole = self._track == ALL_TRACKS
        self._half_width_m = HALF_WIDTH_M if whole else 0.5 * found[0].width
        shared: dict[str, Any] = {
            "half_width_m": self._half_width_m,
            "reward": config.reward,
            "image_errors": config.image_errors,
            "threads": config.threads,
            "tracks_dir": folder,
        }
        names = [track.name if whole else self._track for track in found]
        self._cars = random_cars(
            definition,
            config.envs,
            names,
            config.disturbed,
            state_noise=settings.state_noise,
            **shared,
        )
        self._evaluated = Cars(
            definition,
            names,
            np.zeros(len(names), np.bool_),
            starts={"to_middle": [-GRID_SHARE * track.width for track in found]},
            episode=(EVALUATION_STEPS + 1, EVALUATION_STEPS + 1),
            **shared,
        )

    def run(self) -> dict[str, Any]:
        with RunFolder(self._config.out, self._learner) as folder:
            progress = folder.progress
            while progress.step < self._steps:
                self._segment(folder)
                score, mean_m, max_m = self._evaluate()
                folder.add_evaluation(score, mean_m, max_m, self._actor(progress.step, score))
            return folder.result()

    def close(self) -> None:
        self._cars.close()
        self._evaluated.close()

    def _segment(self, folder: RunFolder) -> None:
        """Train until the next evaluation is due and an update has been made."""
        progress, learner, cars = folder.progress, self._learner, self._cars
        rng = np.random.default_rng([self._config.seed, 1, len(progress.curve)])
        states = cars.reset(int(rng.integers(2**31)))
        due = min(progress.step + self._evaluate_every, self._steps)
        made = 0
        while progress.step < due or made % learner.horizon:
            actions = learner.explore(states, rng)
            step = cars.step(np.clip(actions, -1.0, 1.0))
            left = max(1.0 - progress.step / self._steps, 0.0)
            figures = learner.learn(states, actions, step, rng, left)
            states = step.states
            progress.step += cars.count
            progress.episode += int(np.count_nonzero(step.over))
            made += 1
            if figures:
                progress.loss = figures["loss"]
                folder.add_point(figures)
            if self._report is not None:
                self._report(min(progress.step, self._steps), progress.best_score)

    def _evaluate(self) -> tuple[float, float, float]:
        """Make a drive without noise on each track. Returns the mean reward per step over all
        drives, and the mean and the largest absolute offset (m) in the driven steps.

        As in `controllers drive`, each step after an early end counts 0, or OFF_TRACK_REWARD with
        the quadratic reward.
        """
        cars = self._evaluated
        states = cars.reset(0)
        after = OFF_TRACK_REWARD if self._config.reward == "quadratic" else 0.0
        driving = np.ones(cars.count, np.bool_)
        total, offsets = 0.0, []
        for _ in range(EVALUATION_STEPS):
            step = cars.step(np.clip(self._learner.act(states), -1.0, 1.0))
            total += float(np.where(driving, step.rewards, after).sum())
            offsets.append(np.abs(step.offsets_m[driving]))
            driving &= ~step.ended
            if not driving.any() and not after:
                break
            states = step.states
        driven = np.concatenate(offsets)
        return total / EVALUATION_STEPS / cars.count, float(driven.mean()), float(driven.max())

    def _actor(self, step: int, score: float) -> Actor:
        config, learner = self._config, self._learner
        card = ActorCard(
            state=config.state,
            parts=self._definition.parts,
            half_width_m=self._half_width_m,
            divisor=tuple(learner.divisor.tolist()),
            odd=learner.odd,
            hidden=self._settings.hidden,
            algorithm=config.algorithm,
            track=self._track,
            seed=config.seed,
            step=step,
            score_per_step=score,
            reward=config.reward,
        )
        return Actor(card, learner.weights())

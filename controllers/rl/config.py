"""The configuration of `controllers train`, and the settings of each algorithm."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from controllers import cli_options as options
from trackfeatures.errors import UserError

EXPLORATION_STEPS = 400_000
"""The paper's T_epsilon: the probability of noise on an action falls over this number of control
steps from EXPLORATION_FIRST to EXPLORATION_LEAST."""
EXPLORATION_FIRST, EXPLORATION_LEAST = 1.0, 0.1
QUADRATIC_SCALE = 5.0
"""Factor on `reward_scale` for the quadratic reward, which is about five times smaller than the
paper's first reward."""
EXPLORATION_NOISE = 0.05
"""Standard deviation of the paper's noise on an action in [-1, 1], before the factor beta."""


@dataclass(frozen=True)
class Algorithm:
    """The settings of an algorithm; the defaults are the settings of `ddpg`."""

    critics: int = 1
    """Number of critics. The critics' target is computed from the smallest of their values."""
    actor_delay: int = 1
    """Number of updates of the critics per update of the actor."""
    target_noise: float = 0.0
    """Standard deviation of the noise on the target action; the noise is clipped at 2.5 standard
    deviations."""
    discount: float = 0.99
    tau: float = 0.001
    """Weight of the networks' parameters in the soft update of the target networks:
    target <- tau * parameters + (1 - tau) * target."""
    batch: int = 64
    """Number of transitions in the mini-batch of an update."""
    actor_rate: float = 1e-4
    critic_rate: float = 3e-4
    rate_end: float = 1.0
    """Share of the learning rates that is left at the last step; they fall linearly."""
    beta: float = 4.0
    """The noise on an action has the standard deviation beta * EXPLORATION_NOISE."""
    state_noise: float = 0.05
    """Standard deviation of the noise on the state."""
    random_starts: bool = False
    """Whether episodes have 400 steps and nine of ten begin at a random position and speed.
    Otherwise all episodes have 6500 steps from the paper's start."""
    mirrored: bool = False
    """Whether left and right are exchanged in half of the transitions, and the actor's action
    changes its sign when they are exchanged in the state."""
    scaled: bool = False
    """Whether the networks' inputs are divided by their typical spread."""
    reward_baseline: float = 0.0
    """Number that is subtracted from every reward, also after a terminal state, so that the optimal
    policy is the same."""
    reward_scale: float = 1.0
    """Factor on every reward, after the baseline is subtracted."""
    hidden: tuple[int, int] = (64, 64)
    """Sizes of the two hidden layers."""
    replay: int = 400_000
    """Largest number of transitions that the replay keeps."""
    learning_starts: int = 1000
    """Transitions in the replay before the first update."""


ALGORITHMS = {
    "ddpg": Algorithm(),
    "td3": Algorithm(
        critics=2,
        actor_delay=2,
        target_noise=0.02,
        discount=0.95,
        tau=0.005,
        actor_rate=3e-4,
        critic_rate=5e-4,
        rate_end=0.05,
        beta=2.0,
        state_noise=0.0,
        random_starts=True,
        mirrored=True,
        scaled=True,
        reward_baseline=1.0,
        reward_scale=4.0,
    ),
}


@dataclass(frozen=True)
class PpoSettings:
    """The settings of `ppo`. Fields without a description have the names of Schulman et al. 2016
    and 2017, or are described in `Algorithm`."""

    discount_length_m: float = 15.0
    """The discount factor of a step is exp(-distance of the step / discount_length_m): 0.94 at
    65 km/h."""
    gae_lambda: float = 0.95
    horizon: int = 64
    """Number of control steps of each car between two updates."""
    epochs: int = 4
    minibatches: int = 8
    clip: float = 0.2
    actor_rate: float = 3e-3
    critic_rate: float = 3e-3
    rate_end: float = 0.0
    """Share of the learning rates that is left at the last step; they fall linearly."""
    max_gradient: float = 0.5
    """Largest norm of a gradient, for the actor's gradient and the critic's gradient separately."""
    first_std: float = 0.14
    """Standard deviation of the steering actions at the start; it is learned, with a minimum of
    0.05."""
    state_noise: float = 0.0
    """Standard deviation of the noise on the paper's state."""
    reward_baseline: float = 1.0
    end_steps: int = 32
    """Number of steps after a terminal state for which `reward_baseline` is subtracted, too."""
    reward_scale: float = 1.0
    hidden: tuple[int, int] = (64, 64)


PPO = "ppo"
SETTINGS: dict[str, Algorithm | PpoSettings] = {**ALGORITHMS, PPO: PpoSettings()}


def _defaults(name: str) -> str:
    """Return the values of the setting `name` of all algorithms as text, for the help of an
    option."""
    return ", ".join(f"{key} {getattr(one, name):g}" for key, one in SETTINGS.items())


ALL_TRACKS = "all"


@dataclass(frozen=True)
class TrainConfig:
    """The options of one training. Two trainings with equal configurations give actors that are
    equal bit for bit."""

    out: Annotated[Path, "Folder to write the actor, its curves and its checkpoint to."] = Path(
        "runs/rl"
    )
    algorithm: Annotated[str, f"Algorithm of the training: {', '.join(ALGORITHMS)} or {PPO}."] = (
        "ddpg"
    )
    envs: Annotated[
        int | None,
        Option(
            help="Number of cars that drive at the same time. Default: 256 with ppo, otherwise 1.",
            min=1,
        ),
    ] = None
    track: Annotated[
        str | None,
        "Name of a track (`simulator tracks` lists the names), or its file. With "
        "several cars (--envs) also: all. Then half of the cars drive on all tracks in turn, "
        "and the other half on random roads. Default: forza with one car, otherwise all.",
    ] = None
    seed: Annotated[int, Option(help="Seed of all random numbers of the training.", min=0)] = 0
    steps: Annotated[
        int | None,
        Option(
            help="Number of control steps of 50 ms of all cars together. Default: 400,000 with "
            "one car, otherwise 20,000,000.",
            min=1,
        ),
    ] = None
    state: Annotated[
        str,
        "State that the actor receives. paper: offset, angle, speeds and class of the "
        "road. history: the paper's state, and its changes over the last seven steps. "
        "stacked: the numbers of the state paper (the class as one number), the yaw rate, "
        "the changes of offset and angle since the last step, and the last two actions. "
        "residual: the numbers of the state stacked, and the steering of the controller "
        "lqr, to which the actor adds a correction. With several cars or ppo only paper "
        "and history are possible.",
    ] = "paper"
    disturbed: Annotated[
        float,
        Option(
            help="With several cars: share of the cars, 0 to 1, that have random friction, "
            "mass and throttle in each episode, and noise and delay on their state.",
            min=0.0,
            max=1.0,
        ),
    ] = 0.5
    image_errors: Annotated[
        bool,
        Option(
            "--image-errors",
            help="With several cars: add errors like those of a model in drives on images "
            "(standard deviations 0.022 m and 0.009 rad) to the offset and the angle in "
            "the states of all cars that are not disturbed (--disturbed), also in "
            "evaluations.",
        ),
    ] = False
    state_noise: Annotated[
        float | None,
        "Standard deviation of the noise on each number of the state, without unit: the "
        "offset is divided by half of the track's width, the angle by pi and the speeds "
        f"by 75 km/h. Default: {_defaults('state_noise')}.",
    ] = None
    actor_rate: Annotated[
        float | None,
        f"Learning rate of the actor, above 0. Default: {_defaults('actor_rate')}.",
    ] = None
    critic_rate: Annotated[
        float | None,
        "Learning rate of the critics, which estimate the value of a state in the "
        f"training, above 0. Default: {_defaults('critic_rate')}.",
    ] = None
    reward: options.Reward = "paper"
    evaluate_every: Annotated[
        int | None,
        Option(
            help="Number of control steps of all cars together between two evaluations; a "
            "checkpoint is written after each evaluation. Default: 20,000 with one car, "
            "otherwise 1,000,000.",
            min=1,
        ),
    ] = None
    threads: Annotated[
        int,
        Option(
            help="Number of threads that simulate several cars and train the networks of ppo. "
            "The trained actor does not depend on this number.",
            min=1,
        ),
    ] = 2
    tracks_dir: options.TracksDir = None
    resume: Annotated[
        bool,
        Option(
            "--resume",
            help="Continue the interrupted training in --out with the options with which it was "
            "started; only --threads can be changed.",
        ),
    ] = False

    @property
    def vectorised(self) -> bool:
        """Whether the training uses a vector environment."""
        return self.algorithm == PPO or (self.envs or 1) > 1


def resolve(config: TrainConfig) -> TrainConfig:
    """Return `config` with the number of cars, the track, the steps and the steps between
    evaluations; a missing value gets the default for one car or for several cars.

    Raises UserError if `image_errors` or `disturbed` is set for a training with one car.
    """
    many = config.vectorised
    several = {
        "--image-errors": config.image_errors,
        "--disturbed": config.disturbed not in (0.0, TrainConfig().disturbed),
    }
    for option, given in several.items():
        if given and not many:
            raise UserError(f"{option} needs several cars; give --envs or --algorithm ppo")
    defaults: dict[str, Any] = {
        "envs": 256 if many else 1,
        "track": ALL_TRACKS if many else "forza",
        "steps": 20_000_000 if many else 400_000,
        "evaluate_every": 1_000_000 if many else 20_000,
    }
    missing = {name: value for name, value in defaults.items() if getattr(config, name) is None}
    return replace(config, **missing)


def find_settings(config: TrainConfig) -> Algorithm | PpoSettings:
    """Return the settings of the algorithm, changed by the options in `config`.

    Raises UserError for an unknown algorithm and for a learning rate that is not finite and above
    0.
    """
    if config.algorithm not in SETTINGS:
        raise UserError(
            f"there is no algorithm {config.algorithm!r}; use one of: {', '.join(SETTINGS)}"
        )
    settings = SETTINGS[config.algorithm]
    if config.reward == "quadratic":
        scale = QUADRATIC_SCALE * settings.reward_scale
        settings = replace(settings, reward_baseline=0.0, reward_scale=scale)
    given = {name: getattr(config, name) for name in ("state_noise", "actor_rate", "critic_rate")}
    settings = replace(settings, **{n: value for n, value in given.items() if value is not None})
    for rate in (settings.actor_rate, settings.critic_rate):
        if not 0.0 < rate < math.inf:
            raise UserError(f"the learning rate {rate} is out of range; give one above 0")
    return settings


def exploration_share(step: int) -> float:
    """Return the paper's epsilon: the probability of noise on the action of control step `step`."""
    fall = EXPLORATION_FIRST - EXPLORATION_LEAST
    return max(EXPLORATION_LEAST, EXPLORATION_FIRST - fall * step / EXPLORATION_STEPS)

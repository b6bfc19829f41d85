"""The configuration of `controllers train`, and the settings of each algorithm."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

from controllers import cli_options as options
from trackfeatures.errors import UserError

EXPLORATION_STEPS = 400_000
"""The paper's T_epsilon: the number of steps over which the probability of noise on an action falls
from EXPLORATION_FIRST to EXPLORATION_LEAST."""
EXPLORATION_FIRST, EXPLORATION_LEAST = 1.0, 0.1
QUADRATIC_SCALE = 5.0
"""Factor on `reward_scale` for the quadratic reward, which is about five times smaller."""
EXPLORATION_NOISE = 0.05
"""Standard deviation of the paper's noise on an action before the factor beta."""


@dataclass(frozen=True)
class Algorithm:
    """The settings of an algorithm; the defaults are the settings of `ddpg`."""

    critics: int = 1
    """Number of critics; the target uses the smallest of their values."""
    actor_delay: int = 1
    """Updates of the critics per update of the actor."""
    target_noise: float = 0.0
    """Standard deviation of the noise on the target action; the noise is clipped at 2.5 of it."""
    discount: float = 0.99
    tau: float = 0.001
    """Share of the networks' parameters in the soft update of the target networks."""
    batch: int = 64
    """Transitions per update."""
    actor_rate: float = 1e-4
    critic_rate: float = 3e-4
    rate_end: float = 1.0
    """Share of the learning rates that is left at the last step; they fall linearly."""
    beta: float = 4.0
    """The noise on an action has the standard deviation beta * EXPLORATION_NOISE."""
    state_noise: float = 0.05
    """Standard deviation of the noise on the state."""
    random_starts: bool = False
    """Whether episodes are of 400 steps from a random place and motion; the paper's have 6500."""
    mirrored: bool = False
    """Whether left and right are exchanged in half of the transitions, and the actor is odd."""
    scaled: bool = False
    """Whether the networks' inputs are divided by their typical spread."""
    reward_baseline: float = 0.0
    """Subtracted from every reward, also after a terminal state: the optimal policy is the same."""
    reward_scale: float = 1.0
    """Factor on the rewards."""
    hidden: tuple[int, int] = (64, 64)
    """Sizes of the two hidden layers."""
    replay: int = 400_000
    """Transitions that the replay keeps."""
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


def _defaults(name: str) -> str:
    """The value of a setting for each algorithm, for the help of an option."""
    return ", ".join(f"{key} {getattr(one, name):g}" for key, one in ALGORITHMS.items())


@dataclass(frozen=True)
class TrainConfig:
    """One training. Equal configurations give equal actors, bit for bit."""

    out: Annotated[Path, "Folder for the actor, its curve and its checkpoint."] = Path("runs/rl")
    algorithm: Annotated[str, f"Algorithm: {' or '.join(ALGORITHMS)}."] = "ddpg"
    track: options.Track = "forza"
    seed: Annotated[int, Option(help="Seed of all random numbers of the training.", min=0)] = 0
    steps: Annotated[
        int, Option(help="Control steps of 50 ms, with one update after each.", min=1)
    ] = 400_000
    state: Annotated[str, "State that the actor receives: paper, stacked or residual."] = "paper"
    state_noise: Annotated[
        float | None,
        "Standard deviation of the noise on the paper's state. Default: "
        f"{_defaults('state_noise')}.",
    ] = None
    actor_rate: Annotated[
        float | None, f"Learning rate of the actor. Default: {_defaults('actor_rate')}."
    ] = None
    critic_rate: Annotated[
        float | None, f"Learning rate of the critics. Default: {_defaults('critic_rate')}."
    ] = None
    reward: options.Reward = "paper"
    evaluate_every: Annotated[
        int, Option(help="Steps between two drives; a checkpoint is written after each.", min=1)
    ] = 20_000
    tracks_dir: options.TracksDir = None


def find_algorithm(name: str) -> Algorithm:
    """The settings of the algorithm `name`. Raises UserError for an unknown name."""
    if name not in ALGORITHMS:
        raise UserError(f"there is no algorithm {name!r}; use one of: {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def exploration_share(step: int) -> float:
    """The paper's epsilon: the probability of noise on the action of `step`."""
    fall = EXPLORATION_FIRST - EXPLORATION_LEAST
    return max(EXPLORATION_LEAST, EXPLORATION_FIRST - fall * step / EXPLORATION_STEPS)

"""What the command `controllers train` can be given, and the settings of each algorithm."""

from dataclasses import dataclass
from pathlib import Path

from trackfeatures.errors import UserError

EXPLORATION_STEPS = 400_000
"""The paper's T_epsilon: the probability of noise on an action falls to its least over these."""
EXPLORATION_FIRST, EXPLORATION_LEAST = 1.0, 0.1
QUADRATIC_SCALE = 5.0
"""Times an algorithm's `reward_scale`, for the quadratic reward, which is that much smaller."""
EXPLORATION_NOISE = 0.05
"""Standard deviation of the paper's noise on an action, which beta multiplies."""


@dataclass(frozen=True)
class Algorithm:
    """Settings that nobody needs to change from one training to the next."""

    critics: int
    actor_delay: int
    """Updates of the critics for one of the actor."""
    target_noise: float
    """Standard deviation of the noise on the target's action, cut at 2.5 of them."""
    discount: float
    tau: float
    batch: int
    actor_rate: float
    critic_rate: float
    rate_end: float
    """Share of the learning rates that is left at the last step; they fall linearly."""
    beta: float
    """Times EXPLORATION_NOISE: the noise on an action."""
    state_noise: float
    """Standard deviation of the noise on the state."""
    random_starts: bool
    """Episodes of 400 steps from a random place and motion, in place of the paper's start."""
    mirrored: bool
    """Left and right are exchanged in half of the transitions, and the actor is made odd."""
    scaled: bool
    """The networks' inputs are divided by their spread."""
    reward_baseline: float
    """Subtracted from every reward, those after an end included: the same optimal policy."""
    reward_scale: float
    hidden: tuple[int, int] = (64, 64)
    replay: int = 400_000
    learning_starts: int = 1000


ALGORITHMS = {
    "ddpg": Algorithm(
        critics=1,
        actor_delay=1,
        target_noise=0.0,
        discount=0.99,
        tau=0.001,
        batch=64,
        actor_rate=1e-4,
        critic_rate=3e-4,
        rate_end=1.0,
        beta=4.0,
        state_noise=0.05,
        random_starts=False,
        mirrored=False,
        scaled=False,
        reward_baseline=0.0,
        reward_scale=1.0,
    ),
    "td3": Algorithm(
        critics=2,
        actor_delay=2,
        target_noise=0.02,
        discount=0.95,
        tau=0.005,
        batch=64,
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
class TrainConfig:
    """One training. The same configuration gives the same actor, bit for bit."""

    out: Path = Path("runs/rl")
    algorithm: str = "ddpg"
    track: str = "forza"
    seed: int = 0
    steps: int = 400_000
    """Control steps of 50 ms, with one update each."""
    state: str = "paper"
    state_noise: float | None = None
    """None: the algorithm's own."""
    actor_rate: float | None = None
    critic_rate: float | None = None
    reward: str = "paper"
    """paper, or quadratic: -(0.3 d^2 + angle^2 + 0.03 delta^2)."""
    evaluate_every: int = 20_000
    """Steps between two drives; a checkpoint is written after each."""
    tracks_dir: Path | None = None


def find_algorithm(name: str) -> Algorithm:
    """The settings of `name`. Raises UserError where there are none."""
    if name not in ALGORITHMS:
        raise UserError(f"there is no algorithm {name!r}; use one of: {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def exploration_share(step: int) -> float:
    """The paper's epsilon: the probability of noise on the action of `step`."""
    fall = EXPLORATION_FIRST - EXPLORATION_LEAST
    return max(EXPLORATION_LEAST, EXPLORATION_FIRST - fall * step / EXPLORATION_STEPS)

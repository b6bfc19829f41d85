"""The paper's score of a watched drive, summed step by step."""

from simulator.env.reward import Ending, ending, step_reward
from simulator.world.world import World


class Score:
    """Sums the reward over an episode. A new episode has begun if the simulated time of a state is
    less than the time of the state counted before it."""

    def __init__(self) -> None:
        self.episode = 0
        self._time = float("inf")
        self._begin()

    def _begin(self) -> None:
        self.steps, self.total, self._offsets = 0, 0.0, 0.0
        self.ended: Ending | None = None

    def count(self, world: World) -> float:
        """Add the current state of `world` to the score, once per state. Returns the simulated time
        (s) since the state added before."""
        now = world.state
        passed = now.time_s - self._time
        if passed < 0.0:
            self.episode += 1
            self._begin()
            self._time = now.time_s
            return 0.0
        if passed == 0.0:
            return 0.0
        self._time = now.time_s
        self.ended = ending(now)
        half_width = world.road.half_width
        self.total += step_reward(now.angle, now.to_middle, half_width, self.ended is not None)
        self.steps += 1
        self._offsets += abs(now.to_middle)
        return passed

    def as_dict(self) -> dict[str, float | int | str | None]:
        """Return the score as entries of the state message, by name."""
        steps = max(self.steps, 1)
        return {
            "episode": self.episode,
            "steps": self.steps,
            "score": round(self.total, 2),
            "score_per_step": round(self.total / steps, 4),
            "mean_abs_d_m": round(self._offsets / steps, 3),
            "ended": self.ended,
        }

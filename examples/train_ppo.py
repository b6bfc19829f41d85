"""Trains a steering policy with the PPO of Stable-Baselines3, on many cars and random roads.

Run: `pip install stable-baselines3`, then `python examples/train_ppo.py [STEPS] [CARS]`; the
default is 1,000,000 control steps, summed over 64 cars. Prints the mean reward per control step
over the first tenth and over the last tenth of the episodes, and saves the policy as `ppo.zip` in
the working folder.
"""

import sys

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from simulator.env.stable_baselines import StableBaselinesCars


class Scores(BaseCallback):
    """Collects the mean reward per step of each episode that ends."""

    def __init__(self) -> None:
        super().__init__()
        self.per_step: list[float] = []

    def _on_step(self) -> bool:
        ended = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.per_step += [episode["r"] / episode["l"] for episode in ended]
        return True


def train(steps: int, cars: int) -> tuple[float, float]:
    """Train a policy for `steps` control steps, summed over `cars` cars, and save it. Return the
    mean reward per control step over the first tenth and over the last tenth of the episodes."""
    envs = StableBaselinesCars(
        cars,
        track="random",
        friction=(0.8, 1.2),
        mass=(0.9, 1.1),
        start={"s": (0.0, 3000.0), "to_middle": (-1.0, 1.0), "speed": (5.0, 20.0)},
        max_episode_steps=400,
    )
    policy = PPO(
        "MlpPolicy",
        envs,
        n_steps=32,
        batch_size=min(32 * cars, 2048),
        gamma=0.97,
        learning_rate=1e-3,
        device="cpu",
        seed=0,
    )
    scores = Scores()
    policy.learn(steps, callback=scores)
    policy.save("ppo.zip")
    envs.close()
    tenth = max(len(scores.per_step) // 10, 1)
    return float(np.mean(scores.per_step[:tenth])), float(np.mean(scores.per_step[-tenth:]))


if __name__ == "__main__":
    steps, cars = (int(word) for word in (*sys.argv[1:], *("1000000", "64")[len(sys.argv) - 1 :]))
    first, last = train(steps, cars)
    print(f"score per step: {first:.3f} at the start, {last:.3f} at the end")

"""A vector environment for Stable-Baselines3, which has its own class `VecEnv`.

    from simulator.env.stable_baselines import StableBaselinesCars
    PPO("MlpPolicy", StableBaselinesCars(256, track="random", start={"speed": 10.0}))

It requires the package stable-baselines3.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from simulator.env.vector import LateralControlVector


class StableBaselinesCars(VecEnv):
    """A `VecEnv` of the `count` cars of `LateralControlVector(count, **options)`.

    The last info of an episode contains its score and number of steps under the keys of
    `VecMonitor`.
    """

    def __init__(self, count: int, **options: Any) -> None:
        self.cars = LateralControlVector(count, autoreset_mode=AutoresetMode.SAME_STEP, **options)
        super().__init__(count, self.cars.single_observation_space, self.cars.single_action_space)

    def reset(self) -> Any:
        names = dict.fromkeys(name for own in self._options for name in own)
        starts = {name: [own.get(name) for own in self._options] for name in names}
        observations, _ = self.cars.reset(seed=self._seeds, options=starts)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Any) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        observations, rewards, ended, cut, info = self.cars.step(self._actions)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for k in np.flatnonzero(ended | cut).tolist():
            last, end = info["final_info"], info["final_obs"][k]
            episode = {"r": float(last["score"][k]), "l": int(last["steps"][k]), "t": 0.0}
            infos[k] = {"terminal_observation": end, "episode": episode}
            infos[k]["TimeLimit.truncated"] = bool(cut[k] and not ended[k])
        return observations, rewards.astype(np.float32), ended | cut, infos

    def close(self) -> None:
        self.cars.close()

    def get_images(self) -> Sequence[Any]:
        return self.cars.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.cars, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("the cars of one vector have no attributes of their own to set")

    def env_method(self, method_name: str, *_: Any, indices: Any = None, **__: Any) -> list[Any]:
        raise NotImplementedError("the cars of one vector have no methods of their own to call")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

"""Stable-Baselines3's PPO on a task, at the simulator's own rate.

    pip install stable-baselines3
    python examples/sb3_ppo.py --env-id diffsim/Ant-numpy-v0

Its `make_vec_env` would step 64 environments one after the other. `DiffVecEnv` steps them as one batch.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import diffsim  # noqa: F401  (registers the ids)


class DiffVecEnv(VecEnv):
    """A vector environment of gymnasium's with SAME_STEP autoreset, as Stable-Baselines3 wants it."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[np.floating[Any]]:
        obs, _ = self.env.reset(seed=self._seeds[0])  # one for the batch
        self._reset_seeds()
        return obs

    def step_async(self, actions: NDArray[np.floating[Any]]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        obs, reward, terminated, truncated, info = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = terminated | truncated
        for i in np.flatnonzero(done):  # both keys are SB3's names for what gymnasium says otherwise
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
        return obs, reward, done, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Any:
        return self.env.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env.unwrapped, attr_name)] * len([*self._get_indices(indices)])

    def set_attr(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError("the environments are one batch: use env itself")

    env_method = set_attr

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False] * len([*self._get_indices(indices)])


def train(env_id: str = "diffsim/Ant-numpy-v0", num_envs: int = 64, timesteps: int = 5_000_000, seed: int = 1) -> PPO:
    """Train a policy and print its progress."""
    torch.set_num_threads(1)  # networks this small gain nothing from more, and idle threads disturb the simulator's
    vec_env = VecNormalize(VecMonitor(DiffVecEnv(gymnasium.make_vec(env_id, num_envs=num_envs))))
    steps = 32
    ppo = PPO("MlpPolicy", vec_env, n_steps=steps, batch_size=num_envs * steps // 4, n_epochs=5, seed=seed, verbose=1)
    return ppo.learn(timesteps)


if __name__ == "__main__":
    tyro.cli(train)

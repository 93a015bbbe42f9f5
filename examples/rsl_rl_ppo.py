"""rsl_rl's PPO on a task, on tensors: on a GPU nothing leaves it.

pip install rsl-rl-lib
python examples/rsl_rl_ppo.py --task ant --device cuda --num-envs 4096
"""

from __future__ import annotations

from typing import Any

import torch
import tyro
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import Tensor

import diffsim


class RslRlVecEnv(VecEnv):
    """A DiffEnv as rsl_rl wants it."""

    def __init__(self, env: diffsim.DiffEnv) -> None:
        self.env = env
        self.num_envs, self.num_actions, self.device = env.num_envs, env.scene.nu, env.device
        self.max_episode_length = env.episode_length
        self.cfg: dict[str, Any] = {}
        self._obs, _ = env.reset()

    @property
    def episode_length_buf(self) -> Tensor:
        return self.env.episode_step

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:  # the runner starts episodes at different ages
        self.env.episode_step.copy_(steps)

    def get_observations(self) -> TensorDict:
        return TensorDict({"policy": self._obs}, batch_size=[self.num_envs])

    @torch.no_grad()
    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        self._obs, reward, terminated, truncated, _ = self.env.step(actions)
        return self.get_observations(), reward, terminated | truncated, {"time_outs": truncated}


def train(task: str = "ant", num_envs: int = 64, iterations: int = 1000, device: str = "cpu", seed: int = 1) -> Any:
    """Train a policy; prints its progress and writes it, with checkpoints, to runs/."""
    torch.set_num_threads(1)  # networks this small gain nothing from more, and idle threads disturb the simulator's
    torch.manual_seed(seed)
    network = {"class_name": "MLPModel", "hidden_dims": [128, 64], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"}
    config = {
        "num_steps_per_env": 32,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": gaussian},
        "critic": dict(network),
        "algorithm": {"class_name": "PPO"},
    }
    env = RslRlVecEnv(diffsim.make(task, num_envs, device, seed, horizon=1))
    runner = OnPolicyRunner(env, config, log_dir=f"runs/{task}__rsl_rl__{seed}", device=device)
    runner.learn(iterations, init_at_random_ep_len=True)
    return runner


if __name__ == "__main__":
    tyro.cli(train)

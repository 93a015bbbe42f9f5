"""skrl's PPO on a task, at the simulator's own rate.

    pip install skrl
    python examples/skrl_ppo.py --env-id diffsim/Ant-numpy-v0

skrl knows gymnasium's vector environments: nothing is adapted.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
import tyro
from skrl.envs.wrappers.torch import wrap_env
from skrl.utils.runner.torch import Runner

import diffsim  # noqa: F401  (registers the ids)

NETWORK = [{"name": "net", "input": "OBSERVATIONS", "layers": [128, 64], "activations": "elu"}]
NORMALIZED = "RunningStandardScaler"


def train(env_id: str = "diffsim/Ant-numpy-v0", num_envs: int = 64, timesteps: int = 80_000, seed: int = 1) -> Any:
    """Train a policy for so many steps of all environments; returns skrl's agent. TensorBoard events are in runs/."""
    torch.set_num_threads(1)  # networks this small gain nothing from more, and idle threads disturb the simulator's
    env = wrap_env(gymnasium.make_vec(env_id, num_envs=num_envs), wrapper="gymnasium")
    size = env.observation_space.shape[0]
    config = {
        "seed": seed,
        "models": {
            "separate": True,
            "policy": {"class": "GaussianMixin", "network": NETWORK, "output": "ACTIONS"},
            "value": {"class": "DeterministicMixin", "network": NETWORK, "output": "ONE"},
        },
        "memory": {"class": "RandomMemory", "memory_size": -1},
        "agent": {
            "class": "PPO",
            "rollouts": 32,
            "learning_epochs": 5,
            "mini_batches": 4,
            "learning_rate": 3e-4,
            "time_limit_bootstrap": True,
            "observation_preprocessor": NORMALIZED,
            "observation_preprocessor_kwargs": {"size": size},
            "value_preprocessor": NORMALIZED,
            "value_preprocessor_kwargs": {"size": 1},
            "experiment": {"directory": "runs", "experiment_name": "", "write_interval": "auto"},
        },
        "trainer": {"class": "SequentialTrainer", "timesteps": timesteps, "headless": True},
    }
    runner = Runner(env, config)
    runner.run("train")
    return runner.agent


if __name__ == "__main__":
    tyro.cli(train)

"""CleanRL's PPO, its file unchanged, at the simulator's own rate.

    git clone https://github.com/vwxyzjn/cleanrl
    python examples/cleanrl_ppo.py cleanrl/cleanrl/ppo_continuous_action.py --env-id diffsim/Ant-numpy-v0 --num-steps 32

The script makes `gym.vector.SyncVectorEnv` of functions that make and wrap one environment each, for gymnasium 0.29.
This file runs it with `make_envs` in that place: all environments as one batch, under the same wrappers, with the infos
of gymnasium 0.29. In a copy of the script, write `envs = make_envs(args.env_id, args.num_envs, args.gamma)` instead.
"""

import argparse
import runpy
import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import wrappers
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.wrappers.utils import RunningMeanStd
from numpy.typing import NDArray

import diffsim  # noqa: F401  (registers the ids)


class CleanRLVectorEnv(VectorWrapper):
    """Observations normalized, as gymnasium's own wrapper refuses SAME_STEP; infos["final_info"] as a list of dicts."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self.statistics = RunningMeanStd(shape=env.single_observation_space.shape)

    def normalize(self, obs: NDArray[Any]) -> NDArray[np.float32]:
        self.statistics.update(obs)
        return ((obs - self.statistics.mean) / np.sqrt(self.statistics.var + 1e-8)).clip(-10, 10).astype(np.float32)

    def reset(self, **arguments: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        obs, info = self.env.reset(**arguments)
        return self.normalize(obs), info

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], Any, Any, Any, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(actions)
        episodes: list[Any] = [None] * self.num_envs
        for i in np.flatnonzero(info.get("_episode", ())):
            episodes[i] = {"episode": {key: column[i] for key, column in info["episode"].items()}}
        return self.normalize(obs), reward, terminated, truncated, {"final_info": episodes} if any(episodes) else {}


def make_envs(env_id: str, num_envs: int, gamma: float) -> VectorEnv[Any, Any, Any]:
    """What CleanRL's continuous-action scripts make of num_envs environments; actions are clipped by the task."""
    envs: VectorEnv[Any, Any, Any] = gymnasium.make_vec(env_id, num_envs=num_envs)
    envs = wrappers.vector.RecordEpisodeStatistics(envs)
    envs = wrappers.vector.NormalizeReward(envs, gamma)
    return CleanRLVectorEnv(wrappers.vector.ClipReward(envs, -10, 10))


def main(argv: list[str]) -> dict[str, Any]:
    """Run a script of CleanRL with its arguments; returns its variables."""
    flags = argparse.ArgumentParser(allow_abbrev=False)
    flags.add_argument("--env-id", default="diffsim/Ant-numpy-v0")
    flags.add_argument("--num-envs", type=int, default=64)
    flags.add_argument("--gamma", type=float, default=0.99)
    script, *arguments = argv
    known, others = flags.parse_known_args(arguments)
    torch.set_num_threads(1)  # networks this small gain nothing from more, and idle threads disturb the simulator's

    def sync_vector_env(_: Any) -> VectorEnv[Any, Any, Any]:
        return make_envs(known.env_id, known.num_envs, known.gamma)

    gymnasium.vector.SyncVectorEnv = sync_vector_env  # type: ignore[misc, assignment]
    given = ["--env-id", known.env_id, "--num-envs", str(known.num_envs), "--gamma", str(known.gamma)]
    sys.argv = [script, *given, *others]
    return runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])

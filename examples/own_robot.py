"""A robot and a task of your own, trained by SHAC: all that is needed beside own_robot.xml.

    python examples/own_robot.py

The robot is a bar on two legs in the plane y = 0. It learns to walk forward, by the algorithm of shac.py.
"""

import sys
from pathlib import Path

import torch
import tyro
from torch import Tensor

import diffsim
from diffsim.tasks import Task
from diffsim.training import Evaluation, evaluate

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from shac import SHAC, Args  # noqa: E402


class WalkForward(Task):
    """qpos = (x, height above .6 m, pitch, 2 legs) [m, rad]; action: 60 N m per leg."""

    name = "walk_forward"
    substeps = 16
    episode_length = 300
    obs_dim = 9
    num_random = 10
    start = (0.0,) * 10  # qpos, then qvel: an episode starts uniformly within +- spread / 2 of it
    spread = (0.1,) * 10

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """All but x."""
        return torch.cat((qpos[..., 1:], qvel), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Forward speed, a level bar, small actions."""
        return obs[..., 4] - obs[..., 1].square() - 0.1 * action.square().sum(-1)


def train(iterations: int = 150, num_envs: int = 64, seed: int = 1) -> list[Evaluation]:
    """Evaluations of the policy without noise, every 25 iterations."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    scene = diffsim.load_scene(Path(__file__).with_suffix(".xml"))
    env = diffsim.DiffEnv(WalkForward(), scene, num_envs, seed=seed, horizon=Args.horizon)
    eval_env, evaluations = diffsim.DiffEnv(WalkForward(), scene, num_envs=16), []
    args = Args(iterations=iterations, num_envs=num_envs, actor_hidden=(64, 32), critic_hidden=(64, 64))
    args.critic_lr, args.target_alpha = 2e-3, 0.2
    shac = SHAC(args, env)
    for iteration in range(iterations):
        if iteration % 25 == 0:
            evaluations.append(evaluate(eval_env, shac.policy))
            print(f"iteration {iteration}: {evaluations[-1]}")
        shac.set_learning_rates(iteration + 1)
        shac.update_actor()
        shac.update_critic()
    evaluations.append(evaluate(eval_env, shac.policy))
    print(f"trained: {evaluations[-1]}")
    return evaluations


if __name__ == "__main__":
    tyro.cli(train)

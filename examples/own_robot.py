"""A robot and a task of your own, trained by SHAC: everything that is needed, from the MJCF to the policy.

    python examples/own_robot.py

The robot is a bar on two legs in the plane y = 0. Its task is to walk forward. The algorithm is that of shac.py.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from torch import Tensor

import diffsim
from diffsim.tasks import Task
from diffsim.training import Evaluation, evaluate

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from shac import SHAC, Args  # noqa: E402

MJCF = """
<mujoco model="walker_bar">
  <custom><numeric name="mu" data="0.9"/></custom>
  <default>
    <geom type="capsule" size=".05" density="1000" contype="1" conaffinity="0"/>
    <joint axis="0 -1 0" damping="3" armature=".1"/>
    <motor ctrlrange="-1 1" gear="60"/>
  </default>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1" contype="0" conaffinity="1"/>
    <body name="bar" pos="0 0 .6">
      <camera name="track" mode="trackcom" pos="0 -2.5 .2" xyaxes="1 0 0 0 .12 1"/>
      <joint name="x" type="slide" axis="1 0 0" damping="0" armature="0"/>
      <joint name="z" type="slide" axis="0 0 1" damping="0" armature="0"/>
      <joint name="pitch" axis="0 1 0" damping="0" armature="0"/>
      <geom fromto="-.4 0 0 .4 0 0"/>
      <body name="hind" pos="-.4 0 0">
        <joint name="hind" range="-60 60"/>
        <geom fromto="0 0 0 0 0 -.5"/>
      </body>
      <body name="fore" pos=".4 0 0">
        <joint name="fore" range="-60 60"/>
        <geom fromto="0 0 0 0 0 -.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hind"/><motor joint="fore"/></actuator>
</mujoco>
"""


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
    with TemporaryDirectory() as folder:
        (file := Path(folder) / "robot.xml").write_text(MJCF)
        scene = diffsim.load_scene(file)
    networks: dict[str, Any] = dict(actor_hidden=(64, 32), critic_hidden=(64, 64), critic_lr=2e-3, target_alpha=0.2)
    args = Args(iterations=iterations, num_envs=num_envs, **networks)
    env = diffsim.DiffEnv(WalkForward(), scene, num_envs, seed=seed, horizon=args.horizon)
    eval_env, evaluations = diffsim.DiffEnv(WalkForward(), scene, num_envs=16), []
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

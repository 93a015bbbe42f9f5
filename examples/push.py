"""A task with an object: a ball on two slides pushes a box to a place. docs/own_robot.md explains it.

    python ppo_baseline.py --env examples/push.py --iterations 200

PPO solves it, and RPO nearly as well, though the gradient says little: while nothing touches, and while a force is too
small to slide the box, the box does not depend on the action.
"""

import mujoco
import torch
from torch import Tensor

from diffsim.tasks import Task

ROBOT = """
<mujoco model="push">
  <option timestep="0.004" integrator="implicitfast"/>
  <default><joint type="slide" damping="2"/> <motor gear="20" ctrlrange="-1 1"/></default>
  <worldbody>
    <light pos="0 0 3" directional="true"/>
    <camera name="above" pos="0.2 -1.4 1.4" xyaxes="1 0 0 0 0.7 0.7"/>
    <geom name="table" type="plane" size="0 0 1" friction="0.5" rgba="0.8 0.8 0.8 1"/>
    <body name="ball" pos="0 0 0.06">
      <joint name="x" axis="1 0 0"/> <joint name="y" axis="0 1 0"/>
      <geom type="sphere" size="0.05" mass="1" rgba="0.2 0.4 0.9 1"/>
    </body>
    <body name="box" pos="0.3 0 0.08">
      <freejoint/>
      <geom type="box" size="0.08 0.08 0.08" mass="0.5" friction="0.5" rgba="0.9 0.5 0.2 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x"/> <motor joint="y"/></actuator>
</mujoco>
"""


class Push(Task):
    """qpos = (ball x y, box x y z and quaternion) [m]; action: 20 N along x and y."""

    name = "push"
    asset = mujoco.MjSpec.from_string(ROBOT)
    control_dt = 0.02
    episode_length = 150
    spread = (0.05, 0.05, 0.05, 0.1, *(0.0,) * 5, *(0.0,) * 8)  # of qpos, then qvel
    goal = 0.8, 0.0

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """The box relative to the goal, the ball relative to the box, the box's turn and all velocities."""
        box = qpos[..., 2:4]
        return torch.cat((box - box.new_tensor(self.goal), qpos[..., :2] - box, qpos[..., 5:], 0.3 * qvel), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """The box at its goal, the ball at the box's side, small actions."""
        missing, ball = obs[..., :2], obs[..., 2:4]
        behind = ball - ball.new_tensor((-0.1, 0.0))
        return 1.0 - 4.0 * missing.square().sum(-1) - behind.square().sum(-1) - 0.01 * action.square().sum(-1)

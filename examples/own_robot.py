"""A robot and a task of your own: all that is needed beside own_robot.xml. docs/own_robot.md explains it.

    python ppo_baseline.py --env examples/own_robot.py --iterations 200

The robot is a bar on two legs in the plane y = 0. It learns to run forward in a few minutes.
"""

import torch
from torch import Tensor

from diffsim.tasks import Task


class RunForward(Task):
    """qpos = (x, height above .6 m, pitch, 2 legs) [m, rad]; action: 60 N m per leg."""

    name = "run_forward"  # of the runs' folders
    asset = "own_robot.xml"  # beside this file
    episode_length = 300  # control steps of control_dt = 1/60 s
    spread = 0.1  # of the start: the file's keyframe or reference pose
    min_height = -0.3  # m, of obs[0]; below it the episode ends

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """All but x."""
        return torch.cat((qpos[..., 1:], qvel), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Forward speed, a level bar, small actions, and 2 for not falling."""
        speed, pitch = obs[..., 4], obs[..., 1]
        return 2.0 + 4.0 * speed - 4.0 * pitch.square() - 0.1 * action.square().sum(-1)

"""Humanoid, appendix A.3.5: a two-legged robot with arms runs forward."""

from __future__ import annotations

from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.base import height_reward
from diffsim.tasks.locomotion import Locomotion


class Humanoid(Locomotion):
    """21 joints; action: 35 to 210 N m per joint."""

    name = "humanoid"
    asset, contact = "humanoid.xml", "soft"
    substeps = 48
    fast = Integration("soft", 24, implicit=True)
    obs_dim = 76
    num_random = 55
    min_height = 0.74
    start_height = 1.35
    start_joints = (0.0,) * 21
    target = 200.0
    sides = (("right_", "left_"),)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 20: R_v + 0.1 R_up + R_heading + R_height - 0.002 |a|^2, R_height of Eqs. 21-22."""
        height = height_reward(obs[..., 0] - 0.84, upper=0.1, slope=10.0)
        return self.progress(obs) + height - 0.002 * action.square().sum(-1)

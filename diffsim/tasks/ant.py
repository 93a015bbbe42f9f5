"""Ant, appendix A.3.4: a four-legged robot runs forward."""

from __future__ import annotations

from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.locomotion import Locomotion


class Ant(Locomotion):
    """8 joints; action: 200 N m per joint."""

    name = "ant"
    asset, contact = "ant.xml", "soft"
    substeps = 16
    fast = Integration("soft", 8)
    obs_dim = 37
    num_random = 29
    min_height = 0.27
    start_height = 0.75
    start_joints = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
    target = 10_000.0
    sides = (("_1", "_4"), ("_2", "_3"))

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 19: R_v + 0.1 R_up + R_heading + R_height, R_height = h - 0.27."""
        return self.progress(obs) + (obs[..., 0] - 0.27)

"""Hopper, appendix A.3.3: a one-legged robot in the plane y = 0 hops forward."""

from __future__ import annotations

import math

from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.base import Planar, height_reward


class Hopper(Planar):
    """qpos = (x, height above 1.25 m, pitch, 3 joints) [m, rad]; action: 200 N m per joint."""

    name = "hopper"
    asset, contact = "hopper.xml", "soft"
    substeps = 16
    fast = Integration("soft", 8)
    obs_dim = 11
    num_random = 12
    min_height = -0.45
    start = (0.0,) * 12
    spread = (0.1,) * 12

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 15: R_v + R_height + R_angle - 0.1 |a|^2."""
        height, pitch, forward = obs[..., 0], obs[..., 1], obs[..., 5]
        angle = 1.0 - (pitch / (math.pi / 6)).square()  # Eq. 18
        return forward + height_reward(height + 0.3, upper=0.3, slope=1.0) + angle - 0.1 * action.square().sum(-1)

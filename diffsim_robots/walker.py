"""Walker of guided policy search (Levine and Koltun 2013, appendix B): two legs walk in the plane y = 0.

The reward is the paper's: squared errors of velocity and height, and a cost of torque.
"""

from __future__ import annotations

from torch import Tensor

from diffsim.tasks.base import Planar


class Walker(Planar):
    """qpos = (x, height above 1.4 m, pitch, 6 joints) [m, rad]; action: 150 N m per joint."""

    name = "walker"
    asset, contact = "walker.xml", "soft"
    substeps = 16
    obs_dim = 17
    num_random = 18
    start = (0.0,) * 18
    spread = (0.1,) * 18

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return -(v_x - 1.2)^2 - 10 (height - 1.4)^2 - 1e-4 |a|^2."""
        cost = (obs[..., 8] - 1.2).square() + 10.0 * obs[..., 0].square()
        return -cost - 1e-4 * action.square().sum(-1)

"""Swimmer of guided policy search (Levine and Koltun 2013, appendix B): a snake of three links swims in a fluid.

The reward is the paper's: the squared error of velocity, and a cost of torque.
"""

from __future__ import annotations

from torch import Tensor

from diffsim.tasks.base import Planar


class Swimmer(Planar):
    """qpos = (x, y, yaw, 2 joints) [m, rad]; action: 200 N m per joint."""

    name = "swimmer"
    asset, contact = "swimmer.xml", "soft"
    substeps = 10
    obs_dim = 8
    num_random = 10
    start = (0.0,) * 10
    spread = (0.1,) * 10
    places = 2

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return -(v_x - 2)^2 - 1e-4 |a|^2."""
        return -(obs[..., 3] - 2.0).square() - 1e-4 * action.square().sum(-1)

"""HalfCheetah, appendix A.3.2: a two-legged robot in the plane y = 0 runs forward."""

from __future__ import annotations

from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.base import Planar


class HalfCheetah(Planar):
    """qpos = (x, height above 1 m, pitch, 6 joints) [m, rad]; action: 200 N m per joint."""

    name = "half_cheetah"
    asset, contact = "half_cheetah.xml", "soft"
    substeps = 16
    fast = Integration("soft", 8, implicit=True)
    obs_dim = 17
    num_random = 18
    start = (0.0, -0.2) + (0.0,) * 16
    spread = (0.2,) * 9 + (0.5,) * 9

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 14: v_x - 0.1 |a|^2."""
        return obs[..., 8] - 0.1 * action.square().sum(-1)

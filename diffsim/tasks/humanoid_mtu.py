"""HumanoidMTU, appendix A.3.6: the lower body of a human, pulled by 152 muscle-tendon units, runs forward."""

from __future__ import annotations

from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.base import height_reward
from diffsim.tasks.locomotion import Locomotion

UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # of a ball joint, wxyz
LEG = (*UPRIGHT, 0.0, *UPRIGHT, 0.0, 0.0)  # hip, knee, ankle, two toes


class HumanoidMTU(Locomotion):
    """4 ball and 6 hinge joints; action: activation of 0 (at -1) to 1 (at 1) of 152 muscles of 16 to 645 N."""

    name = "humanoid_mtu"
    asset, contact = "humanoid_mtu.xml", "soft"
    substeps = 48
    fast = Integration("soft", 24)
    obs_dim = 53
    num_random = 53
    min_height = 0.46
    start_height = 1.0
    start_joints = LEG + LEG
    joint_rates = 18
    joint_spread = 0.0
    observe_action = False
    target = 10_000.0
    mirrored_by = None  # the left big toe is where the little toes should be

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 23: R_v + 0.1 R_up + R_heading + R_height - 0.001 |a|^2, a activations, R_height of Eqs. 24-25."""
        height = height_reward(obs[..., 0] - 0.51, upper=0.05, slope=4.0)
        return self.progress(obs) + height - 0.001 * (0.5 * action + 0.5).square().sum(-1)

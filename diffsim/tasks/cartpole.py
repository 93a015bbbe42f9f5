"""CartPole swing up, appendix A.3.1: a motor on the cart swings the hanging pole up and holds it there."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.sim.integration import Integration
from diffsim.tasks.base import Task


class CartPole(Task):
    """qpos = (x [m], theta [rad], 0 upright); action: 1000 N on the cart."""

    name = "cartpole"
    asset, contact = "cartpole.xml", "soft"
    substeps = 4
    fast = Integration("soft", 1, implicit=True)
    episode_length = 240
    obs_dim = 5
    num_random = 4
    start = (0.0, -math.pi, 0.0, 0.0)
    spread = (math.pi, math.pi, 0.5, 0.5)

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        self._cost = torch.tensor((0.05, 0.1, 0.0, 0.0, 0.1), device=device, dtype=dtype)

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """Return Table 6: x, x', sin theta, cos theta, theta'."""
        x, theta = qpos.split(1, dim=-1)
        x_dot, theta_dot = qvel.split(1, dim=-1)
        return torch.cat((x, x_dot, theta.sin(), theta.cos(), theta_dot), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return Eq. 13: -theta^2 - 0.1 theta'^2 - 0.05 x^2 - 0.1 x'^2, theta in [-pi, pi]."""
        theta = torch.atan2(obs[..., 2], obs[..., 3])
        return -theta.square() - (obs.square() * self._cost).sum(-1)

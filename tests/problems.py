"""A bandit and a linear-quadratic system without simulator, whose soft optima are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor


class Problem:
    """An environment for learners with a discount of 0.9; a model can learn the linear system's noise."""

    device, episode_length = torch.device("cpu"), 10**9
    scene = SimpleNamespace(nu=1)

    def __init__(self, bandit: bool, num_envs: int) -> None:
        self.bandit, self.num_envs, self.x = bandit, num_envs, torch.zeros(num_envs, 1)
        self.task = SimpleNamespace(obs_dim=1, terminated=lambda obs: torch.full((len(obs),), bandit))
        self.sim = SimpleNamespace(nonfinite_gradients=torch.zeros(num_envs, dtype=torch.int32))

    def detach(self) -> Tensor:
        return self.x

    def step(self, action: Tensor) -> tuple[Any, ...]:
        """The bandit pays for a = 0.3; the linear system x' = 0.8 x + a + noise costs x^2 + a^2."""
        no = torch.zeros(self.num_envs, dtype=torch.bool)
        if self.bandit:
            reward, next_obs, terminated = -4 * (action - 0.3).square().squeeze(1), self.x, ~no
        else:
            reward = -(self.x.square() + action.square()).squeeze(1)
            next_obs, terminated = 0.8 * self.x + action + 0.3 * torch.randn_like(self.x), no
        self.x = next_obs
        info = {"final_obs": next_obs, "nonfinite": no, "episode": {"r": reward, "l": torch.ones(self.num_envs)}}
        return next_obs, reward, terminated, no, info


def assert_bandit_learnt(actor: Callable[[Tensor], tuple[Tensor, Tensor]], temperature: float, error: float) -> None:
    """The soft optimum is proportional to exp(r / alpha): here the Gaussian of mean 0.3 and variance alpha / 8."""
    action, _ = actor(torch.zeros(4000, 1))
    assert action.mean().item() == pytest.approx(0.3, abs=error)
    assert action.std().item() == pytest.approx(math.sqrt(temperature / 8), rel=0.25)


def assert_system_controlled(policy: Callable[[Tensor], Tensor]) -> None:
    """The optimal gain is that of the discounted Riccati equation; entropy shows more actions."""
    p = 1.0
    for _ in range(200):
        p = 1 + 0.9 * 0.64 * p - (0.9 * 0.8 * p) ** 2 / (1 + 0.9 * p)
    gain = 0.9 * 0.8 * p / (1 + 0.9 * p)
    x = torch.linspace(-0.6, 0.6, 13).unsqueeze(1)
    slope = ((x * policy(x).detach()).sum() / x.square().sum()).item()
    assert slope == pytest.approx(-gain, rel=0.2)

"""Returns, SAC's equations, and a linear-quadratic problem without simulator, whose optimum is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from diffsim.learning.replay import Transition

Array = NDArray[Any]


def lambda_returns(reward: Array, following: Array, done: Array, gamma: float, lam: float) -> Array:
    """(T, N): of each step the weighted sum of all its n-step returns until the episode or the rollout ends.

    Args:
        following: (T, N) values of the states after the steps.
    """
    horizon, expected = len(reward), np.zeros(reward.shape)
    for t, i in np.ndindex(reward.shape):
        n = next((k for k in range(1, horizon - t) if done[t + k - 1, i]), horizon - t)  # steps to the end
        returns = [
            sum(gamma**j * reward[t + j, i] for j in range(k)) + gamma**k * following[t + k - 1, i]
            for k in range(1, n + 1)
        ]
        expected[t, i] = np.dot([*((1 - lam) * lam ** (k - 1) for k in range(1, n)), lam ** (n - 1)], returns)
    return expected


class Problem:
    """x' = 0.8 x + a + noise costs x^2 + a^2, for learners with a discount of 0.9; a model can learn the noise."""

    device, episode_length = torch.device("cpu"), 10**9
    scene = SimpleNamespace(nu=1)

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.x = num_envs, torch.zeros(num_envs, 1)
        self.task = SimpleNamespace(
            obs_dim=1, actor_dim=None, terminated=lambda obs: torch.zeros(len(obs), dtype=torch.bool)
        )
        self.sim = SimpleNamespace(nonfinite_gradients=torch.zeros(num_envs, dtype=torch.int32))

    def detach(self) -> Tensor:
        return self.x

    def step(self, action: Tensor) -> tuple[Any, ...]:
        no = torch.zeros(self.num_envs, dtype=torch.bool)
        reward = -(self.x.square() + action.square()).squeeze(1)
        self.x = 0.8 * self.x + action + 0.3 * torch.randn_like(self.x)
        info = {"final_obs": self.x, "nonfinite": no, "episode": {"r": reward, "l": torch.ones(self.num_envs)}}
        return self.x, reward, no, no, info


def assert_system_controlled(policy: Callable[[Tensor], Tensor]) -> None:
    """The optimal gain is that of the discounted Riccati equation; entropy shows more actions."""
    p = 1.0
    for _ in range(200):
        p = 1 + 0.9 * 0.64 * p - (0.9 * 0.8 * p) ** 2 / (1 + 0.9 * p)
    gain = 0.9 * 0.8 * p / (1 + 0.9 * p)
    x = torch.linspace(-0.6, 0.6, 13).unsqueeze(1)
    slope = ((x * policy(x).detach()).sum() / x.square().sum()).item()
    assert slope == pytest.approx(-gain, rel=0.2)


def assert_squashed_gaussian(actor: Any) -> None:
    """Of the ant: the density of what it draws is torch's, and its deterministic policy draws without noise."""
    torch.manual_seed(0)
    obs = torch.randn(50, 37, dtype=torch.float64)
    action, density = actor.double()(obs)
    features = actor.body(obs)
    log_std = actor.log_std(features).clamp(-5.0, 2.0)
    expected = TransformedDistribution(Normal(actor.mean(features), log_std.exp()), TanhTransform())
    torch.testing.assert_close(density, expected.log_prob(action).sum(-1))
    assert action.std(0).min() > 0.1
    torch.testing.assert_close(actor.deterministic()(obs), torch.tanh(actor.mean(features)))


def assert_soft_updates(
    learner: Any,
    optimizers: tuple[Any, Any],
    monkeypatch: pytest.MonkeyPatch,
    subset: int | None = None,
    act: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None,
) -> None:
    """At a temperature of 0.3: the soft Bellman backup, where a failure ends the value, the losses, and the targets.

    With a subset of the critics (REDQ) the backup takes the least of so many, and the actor the mean of all.

    Args:
        optimizers: of the actor and of the temperature.
        act: actions and their log densities of observations, if the actor itself does not return these.
    """
    torch.manual_seed(0)
    act, inputs, nu = act or learner.actor, learner.env.task.obs_dim, learner.env.scene.nu
    learner.temperature["log"].data.fill_(math.log(0.3))
    obs, next_obs, failed = torch.randn(32, inputs), torch.randn(32, inputs), (torch.rand(32) < 0.3).float()
    batch = Transition(obs, torch.rand(32, nu), torch.randn(32), next_obs, failed)
    critics = len(learner.critics.layers[0].bias)
    for p in learner.targets.parameters():
        p.data.add_(0.1 * torch.randn_like(p))  # far from the critics, which have made no step

    def values(networks: Any, obs: Tensor, action: Tensor) -> Tensor:
        return torch.stack([networks[k](torch.cat((obs, action), 1)).squeeze(1) for k in range(critics)])

    state = torch.get_rng_state()
    action, density = act(next_obs)
    chosen = torch.rand(critics).argsort()[:subset] if subset else slice(None)
    soft = values(learner.targets, next_obs, action)[chosen].amin(0) - 0.3 * density
    target = (batch.reward + 0.99 * (1 - failed) * soft).detach()
    loss = (values(learner.critics, obs, batch.action) - target).square().mean()
    before = [p.clone() for p in learner.targets.parameters()]
    torch.set_rng_state(state)
    torch.testing.assert_close(learner.update_critics(batch, obs, next_obs)["losses/critic"], loss)
    for old, slow, fast in zip(before, learner.targets.parameters(), learner.critics.parameters(), strict=True):
        torch.testing.assert_close(slow, old + 0.005 * (fast - old))

    losses: list[Tensor] = []
    for optimizer in optimizers:
        monkeypatch.setattr(optimizer, "gradient", lambda loss: losses.append(loss) or loss)
        monkeypatch.setattr(optimizer, "step", lambda loss: loss)
    state = torch.get_rng_state()
    learner.update_actor(obs)
    torch.set_rng_state(state)
    action, density = act(obs)
    value = values(learner.critics, obs, action)
    torch.testing.assert_close(losses[0], (0.3 * density - (value.mean(0) if subset else value.amin(0))).mean())
    torch.testing.assert_close(losses[1], 0.3 * (nu - density.mean().detach()))

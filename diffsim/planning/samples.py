"""Trajectories with their densities under all distributions that any of them came from: importance weights over time.

Densities are those of prefixes of trajectories, as logarithms (Levine and Koltun 2013, section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from diffsim.planning.controller import LinearGaussian
from diffsim.planning.system import System


class Policy(Protocol):
    """A policy whose weights are one vector theta; its own theta is the best so far."""

    theta: Tensor

    def log_prob(self, theta: Tensor, obs: Tensor, u: Tensor) -> Tensor:
        """(...) log pi_theta(u|o) of obs (..., obs_dim), u (..., nu)."""


class Samples(NamedTuple):
    """m trajectories."""

    x: Tensor  # (m, T + 1, nx)
    obs: Tensor  # (m, T, obs_dim) on which u acted
    u: Tensor  # (m, T, nu)
    reward: Tensor  # (m, T), bounded from below
    native: Tensor  # (m, T) the task's own
    source: Tensor  # (m,) index of the generator it came from
    log_q: Tensor  # (m, n, T) log density of its prefixes under each generator

    def pick(self, index: Tensor | slice) -> Samples:
        return Samples(*(tensor[index] for tensor in self))

    @property
    def returns(self) -> Tensor:
        return self.reward.sum(1)

    @property
    def log_mixture(self) -> Tensor:
        """(m, T) log density of prefixes under the mixture of the distributions that these samples come from."""
        return log_mixture(self.log_q[:, self.source.unique()])


class SampleSet:
    """S: samples, and the distributions that they come from."""

    def __init__(self, system: System, policy: Policy, samples: Samples) -> None:
        self.system, self.policy, self.samples = system, policy, samples
        self.generators: list[LinearGaussian | Tensor] = []  # guides, the initial ones first, and policies as theta
        self.best = -1  # theta*'s index among them
        self.initial = 0  # initial guides among them

    def log_density(self, generator: LinearGaussian | Tensor, samples: Samples) -> Tensor:
        """(m, T) of prefixes."""
        if isinstance(generator, LinearGaussian):
            return generator.log_prob(self.system, samples.x, samples.u).cumsum(1)
        return self.policy.log_prob(generator, samples.obs, samples.u).cumsum(1)

    def append(self, samples: Samples, *new: LinearGaussian | Tensor) -> Tensor:
        """Adds samples, and the generators that they are the first of; returns the samples' indices."""
        for generator in new:
            self.generators.append(generator)
            column = self.log_density(generator, self.samples).unsqueeze(1)
            self.samples = self.samples._replace(log_q=torch.cat((self.samples.log_q, column), 1))
        log_q = torch.stack([self.log_density(generator, samples) for generator in self.generators], 1)
        first, joined = len(self.samples.u), zip(self.samples, samples._replace(log_q=log_q), strict=True)
        self.samples = Samples(*(torch.cat(tensors) for tensors in joined))
        return torch.arange(first, len(self.samples.u), device=log_q.device)

    def score(self) -> Tensor:
        """(m,) sum of a sample's weights under theta*; ties are broken by its density."""
        S, policy = self.samples, self.policy
        log_w = log_weights(policy.log_prob(policy.theta, S.obs, S.u), S.log_mixture)
        return torch.softmax(log_w, 0).sum(1) + 1e-9 * log_w[:, -1].clamp(min=-1e6)

    def choose(self, active: int, newest: int) -> Tensor:
        """Indices of theta*'s newest, of the initial guides' samples (adapted guides have too many), then by weight."""
        score = torch.where(self.samples.source < self.initial, 2e9, self.score())
        score[(self.samples.source == self.best).nonzero().flatten()[-newest:]] = 3e9
        return score.argsort(descending=True, stable=True)[:active].sort().values

    def prune(self, stored: int) -> None:
        """Keeps so many: the initial guides', those of theta*, the best-scored others; drops generators without any."""
        if len(self.samples.u) <= stored:
            return
        score = self.score() + 2e9 * (self.samples.source < self.initial) + 1e9 * (self.samples.source == self.best)
        kept = self.samples.pick(score.argsort(descending=True, stable=True)[:stored].sort().values)
        used = torch.tensor(sorted({*kept.source.tolist(), self.best}), device=score.device)
        index = torch.full((len(self.generators),), -1, device=used.device)
        index[used] = torch.arange(len(used), device=used.device)
        self.samples = kept._replace(source=index[kept.source], log_q=kept.log_q[:, used])
        self.generators, self.best = [self.generators[i] for i in used.tolist()], int(index[self.best])

    def state_dict(self) -> dict[str, Any]:
        generators = [tuple(g) if isinstance(g, LinearGaussian) else (g,) for g in self.generators]
        return dict(samples=tuple(self.samples), generators=generators, best=self.best, initial=self.initial)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        device = self.system.device
        self.samples = Samples(*(tensor.to(device) for tensor in state["samples"]))
        stored = ([tensor.to(device) for tensor in generator] for generator in state["generators"])
        self.generators = [LinearGaussian(*tensors) if len(tensors) > 1 else tensors[0] for tensors in stored]
        self.best, self.initial = state["best"], state["initial"]


def log_mixture(log_q: Tensor) -> Tensor:
    """(m, T) log of the mixture of n densities log q_j (m, n, T)."""
    return torch.logsumexp(log_q, 1) - math.log(log_q.shape[1])


def log_weights(log_pi: Tensor, log_mix: Tensor) -> Tensor:
    """(m, T) log pi(zeta_1:t) / q(zeta_1:t) from per-step log pi (m, T)."""
    return log_pi.cumsum(1) - log_mix


def sparse(value: Callable[[Tensor], Tensor], policy: Policy, theta: Tensor, S: Samples) -> Tensor:
    """A function () of log pi_theta (m, T), with its gradient in theta by Appendix A's sum over steps.

    Steps that count for less than rounding are left out: most, as few samples have a weight that is not negligible.
    """
    log_pi = policy.log_prob(theta.detach(), S.obs, S.u).requires_grad_()
    result = value(log_pi)
    (slope,) = torch.autograd.grad(result, log_pi)
    rows = slope.abs() > 1e-20 * slope.abs().max()
    linear = (slope[rows] * policy.log_prob(theta, S.obs[rows], S.u[rows])).sum()
    return result.detach() + linear - linear.detach()


def phi(log_pi: Tensor, log_mix: Tensor, reward: Tensor, w_r: float) -> Tensor:
    """The objective of Section 3: Eq. 2 and the regulariser, of rewards (m, T). At w_r = 0 the value estimate."""
    log_w = log_weights(log_pi, log_mix)
    log_z = torch.logsumexp(log_w, 0) - math.log(len(log_w))
    return (torch.softmax(log_w, 0) * reward).sum() + w_r * log_z.sum()

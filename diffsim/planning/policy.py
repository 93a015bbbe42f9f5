"""A Gaussian policy whose parameters are one vector, as L-BFGS and checkpoints of a search take it."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim.planning.controller import gaussian_log_prob
from diffsim.planning.lbfgs import maximise
from diffsim.planning.samples import Samples
from diffsim.planning.system import System

BATCH = 256  # of imitate


class GaussianPolicy(nn.Module):
    """pi_theta(u|o): Gaussian about a network of one softplus layer; theta is one vector of all its weights."""

    def __init__(self, hidden: int, system: System) -> None:
        super().__init__()
        inputs, outputs = len(system.observed), system.nu
        self.shapes = (hidden, inputs), (hidden,), (outputs, hidden), (outputs,)
        self.sizes = [math.prod(shape) for shape in self.shapes]
        self.observed = system.observed
        self.obs_mean: Tensor = nn.Buffer(torch.zeros_like(self.observed))
        self.obs_std: Tensor = nn.Buffer(torch.ones_like(self.observed))
        self.u_mean: Tensor = nn.Buffer(self.observed.new_zeros(outputs))
        self.u_std: Tensor = nn.Buffer(self.observed.new_ones(outputs))
        self.sigma: Tensor = nn.Buffer(self.observed.new_ones(outputs))  # fixed
        self.theta: Tensor = nn.Buffer(self.observed.new_zeros(sum(self.sizes)))

    def standardise(self, obs: Tensor, u: Tensor) -> None:
        """Inputs and outputs of the network have mean 0 and deviation 1 over these (n, obs_dim), (n, nu)."""
        self.obs_mean, self.obs_std = obs.mean(0), obs.std(0).clamp(min=1e-3)
        self.u_mean, self.u_std = u.mean(0), u.std(0).clamp(min=1e-3)

    def split(self, theta: Tensor) -> list[Tensor]:
        """The weights and biases (hidden, obs_dim), (hidden,), (nu, hidden), (nu,) of theta."""
        return [part.view(shape) for part, shape in zip(theta.split(self.sizes), self.shapes, strict=True)]

    def initial(self, rng: torch.Generator) -> Tensor:
        """A random theta."""
        scales = len(self.obs_mean) ** -0.5, 1.0, 0.1, 0.0
        draws = [scale * torch.randn(size, generator=rng) for scale, size in zip(scales, self.sizes, strict=True)]
        return torch.cat(draws).to(self.sigma)

    def mean(self, theta: Tensor, obs: Tensor) -> Tensor:
        """(..., nu) of obs (..., obs_dim)."""
        w1, b1, w2, b2 = self.split(theta)
        hidden = F.softplus(F.linear((obs - self.obs_mean) / self.obs_std, w1, b1))
        return self.u_mean + self.u_std * F.linear(hidden, w2, b2)

    def log_prob(self, theta: Tensor, obs: Tensor, u: Tensor) -> Tensor:
        """(...) log pi_theta(u|o)."""
        return gaussian_log_prob(u, self.mean(theta, obs), self.sigma)

    def sparse(self, value: Callable[[Tensor], Tensor], theta: Tensor, S: Samples) -> Tensor:
        """A function () of log pi_theta (m, T), with its gradient in theta by Levine and Koltun's Appendix A.

        Steps that count for less than rounding are left out: most, as few samples have a weight that is not negligible.
        """
        log_pi = self.log_prob(theta.detach(), S.obs, S.u).requires_grad_()
        result = value(log_pi)
        (slope,) = torch.autograd.grad(result, log_pi)
        rows = slope.abs() > 1e-20 * slope.abs().max()
        linear = (slope[rows] * self.log_prob(theta, S.obs[rows], S.u[rows])).sum()
        return result.detach() + linear - linear.detach()

    def fit(self, theta: Tensor, obs: Tensor, u: Tensor, iterations: int) -> Tensor:
        """The theta under which actions (..., nu) at observations (..., obs_dim) are likeliest, from a first one."""
        return maximise(lambda theta: self.log_prob(theta, obs, u).mean(), theta, iterations)[0]

    def imitate(self, obs: Tensor, u: Tensor, epochs: int, rng: torch.Generator) -> Tensor:
        """A theta whose means are close to actions (n, nu) at observations (n, obs_dim), by Adam from a random one."""
        theta = self.initial(rng).requires_grad_()
        adam = torch.optim.Adam([theta], lr=3e-3)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs)
        for _ in range(epochs):
            for batch in torch.randperm(len(obs), generator=rng).to(obs.device).split(BATCH):
                error = (self.mean(theta, obs[batch]) - u[batch]) / self.u_std
                (theta.grad,) = torch.autograd.grad(error.square().mean(), theta)
                adam.step()
            decay.step()
        return theta.detach()

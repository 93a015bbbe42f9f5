"""Gaussian controllers: linear in the state about a trajectory, for all times, from iLQR."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.planning.ilqr import Cost, Plan, backward_pass, step_jacobian, symmetric
from diffsim.planning.system import REAL, System


def gaussian_log_prob(u: Tensor, mean: Tensor, sigma: Tensor) -> Tensor:
    """(...) log density of u (..., nu) under independent normals about mean (..., nu), of standard deviation (nu,)."""
    e = (u - mean) / sigma
    return -0.5 * e.square().sum(-1) - (sigma.log() + 0.5 * math.log(2 * math.pi)).sum()


class LinearGaussian(NamedTuple):
    """u ~ N(ubar + K (x - xbar), L L') about a trajectory of T steps."""

    x: Tensor  # (T + 1, nx)
    u: Tensor  # (T, nu)
    K: Tensor  # (T, nu, 2nv)
    L: Tensor  # (T, nu, nu) Cholesky factor of the covariance Q_uu^-1
    mu: Tensor  # () regularisation of the pass that made it; 0 unless Q_uu was not positive definite

    def mean(self, system: System, t: int | slice, x: Tensor) -> Tensor:
        """(..., nu) at states x (..., nx) of step t, or (..., steps, nx) of a slice of steps."""
        tangent = system.difference(x, self.x[t])
        return self.u[t] + (self.K[t] @ tangent.unsqueeze(-1)).squeeze(-1)

    def widened(self, sigma: Tensor) -> LinearGaussian:
        """Return the same feedback with noise of another scale: the root mean square of its deviations / sigma is 1."""
        width = self.L.square().sum(-1).sqrt() / sigma
        return self._replace(L=self.L / width.square().mean().sqrt())

    def log_prob(self, system: System, x: Tensor, u: Tensor) -> Tensor:
        """(m, T) log q(u_t | x_t) of anyone's trajectories x (m, T + 1, nx), u (m, T, nu)."""
        error = (u - self.mean(system, slice(0, u.shape[1]), x[:, :-1])).unsqueeze(-1)
        e = torch.linalg.solve_triangular(self.L, error, upper=False).squeeze(-1)
        log_det = self.L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return -0.5 * e.square().sum(-1) - log_det - 0.5 * u.shape[-1] * math.log(2 * math.pi)

    def sample(self, system: System, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Closed-loop rollouts with standard normal noise (m, T, nu); see System.rollout."""

        def act(t: int, x: Tensor) -> Tensor:
            return self.mean(system, t, x) + (self.L[t] @ noise[:, t].unsqueeze(-1)).squeeze(-1)

        return system.rollout(self.x[0].expand(len(noise), -1), noise.shape[1], act)


@torch.no_grad()
def maximum_entropy_controllers(system: System, cost: Cost, plan: Plan) -> list[LinearGaussian]:
    """The I-projections of exp(-cost) about R optimised trajectories (Levine and Koltun 2013, section 4.1).

    Their k is left out: it vanishes where iLQR converged. The cost is in nats.
    """
    f_z = step_jacobian(system, plan.x, plan.u)
    quadratic = cost.quadratic(plan.x, plan.u, f_z)
    mu = torch.zeros_like(plan.cost)
    gains = backward_pass(f_z, *quadratic, mu)
    while not bool(gains.ok.all()):
        mu = torch.where(gains.ok, mu, (4 * mu).clamp(min=1e-6))
        gains = backward_pass(f_z, *quadratic, mu)
    covariance = torch.linalg.inv(gains.Q_uu + 1e-9 * torch.eye(system.nu, dtype=REAL, device=mu.device))
    L = torch.linalg.cholesky(symmetric(covariance))
    return [LinearGaussian(*tensors) for tensors in zip(plan.x, plan.u, gains.K, L, mu, strict=True)]

"""Gaussian controllers: linear ones about a trajectory, all over time, which are what iLQR knows beside its plan."""

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
    L: Tensor  # (T, nu, nu) Cholesky factor of the covariance eta Q_uu^-1
    eta: Tensor  # () the temperature of exp(-cost / eta), of which this is the I-projection
    mu: Tensor  # () regularisation of the pass that made it; 0 unless Q_uu was not positive definite

    def first(self, steps: int) -> LinearGaussian:
        """Its first steps."""
        return self._replace(x=self.x[: steps + 1], u=self.u[:steps], K=self.K[:steps], L=self.L[:steps])

    def mean(self, system: System, t: int | slice, x: Tensor) -> Tensor:
        """(..., nu) at states x (..., nx) of step t, or (..., steps, nx) of a slice of steps."""
        tangent = system.difference(x, self.x[t])
        return self.u[t] + (self.K[t] @ tangent.unsqueeze(-1)).squeeze(-1)

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


def nearest_feedback(
    system: System, guides: list[LinearGaussian], x: Tensor, scale: Tensor, bound: float = math.inf, blend: float = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """The feedback of the controllers' steps that look most like states, whatever the time.

    The place along x is not observed. It counts for the feedback alone, so that a late policy catches up, and on a
    terrain not at all, as a guide's place belongs to its own terrain.

    Args:
        x: (m, nx) states.
        scale: (obs_dim,) of observations, in which their differences are measured.
        bound: of each controller's actions.
        blend: b > 0 gives a mean over the controllers, with weights exp(-(d / b)^2) of their nearest steps at distance
            d; 0 gives the action of the nearest one.

    Returns:
        Actions (m, nu); L (m, nu, nu) of the nearest step of all, and its root mean square distance (m,).
    """
    own, parts = system.observe(x) / scale, []
    for guide in guides:
        path = guide.x[: len(guide.u)]
        looks = system.observe(path) / scale
        distance, t = torch.cdist(own, looks, compute_mode="donot_use_mm_for_euclid_dist").min(1)
        tangent = (system.difference(x, path[t]) * system.counts).unsqueeze(-1)
        u = (guide.u[t] + (guide.K[t] @ tangent).squeeze(-1)).clamp(-bound, bound)
        parts.append((u, guide.L[t], distance / own.shape[1] ** 0.5))
    u, L, distance = (torch.stack(part) for part in zip(*parts, strict=True))
    nearest = distance.argmin(0), torch.arange(len(x), device=x.device)
    weight = torch.softmax(-(distance / blend).square(), 0).unsqueeze(-1) if blend else None
    return u[nearest] if weight is None else (weight * u).sum(0), L[nearest], distance[nearest]


@torch.no_grad()
def maximum_entropy_controllers(
    system: System, cost: Cost, plan: Plan, sigma: Tensor, spread: float
) -> list[LinearGaussian]:
    """The I-projections of exp(-cost / eta) about R optimised trajectories (Levine and Koltun 2013, section 4.1).

    Their k is left out: it vanishes where iLQR converged.

    Args:
        cost: of which the plan's trajectories are optima.
        sigma, spread: eta is such that no motor's median standard deviation over time is beyond spread sigma (nu,); 1,
            the paper's, for spread 0.
    """
    f_z = step_jacobian(system, plan.x, plan.u)
    quadratic = cost.quadratic(plan.x, plan.u, f_z)
    mu = torch.zeros_like(plan.cost)
    gains = backward_pass(f_z, *quadratic, mu)
    while not bool(gains.ok.all()):
        mu = torch.where(gains.ok, mu, (4 * mu).clamp(min=1e-6))
        gains = backward_pass(f_z, *quadratic, mu)
    covariance = torch.linalg.inv(gains.Q_uu + 1e-9 * torch.eye(system.nu, dtype=REAL, device=mu.device))
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt().median(1).values  # (R, nu)
    eta = (spread * sigma / std).amin(-1).square() if spread else torch.ones_like(mu)
    L = torch.linalg.cholesky(eta.view(-1, 1, 1, 1) * symmetric(covariance))
    return [LinearGaussian(*tensors) for tensors in zip(plan.x, plan.u, gains.K, L, eta, mu, strict=True)]

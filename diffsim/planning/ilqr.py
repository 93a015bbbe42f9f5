"""Iterative LQR (Li and Todorov 2004): dynamic programming about trajectories, many of them side by side.

With Gauss-Newton's second derivatives (none of the dynamics), the state regularisation of Tassa, Erez and Todorov 2012
("Synthesis and stabilization of complex behaviors through online trajectory optimization"), and all step sizes of the
line search in one batch.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from diffsim.planning.system import REAL, System

ALPHAS = 0.5 ** torch.arange(11, dtype=REAL)  # step sizes of the line search


class Cost(Protocol):
    """The problem of R trajectories of T steps."""

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        """(R, A, T) cost of each step, of A candidates x (R, A, T + 1, nx), u (R, A, T, nu) for each trajectory."""

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, T, nz) and positive semidefinite Hessian (R, T, nz, nz) in z = (tangent of x_t, u_t), of
        x (R, T + 1, nx), u (R, T, nu) whose steps have the Jacobians f_z (R, T, nd, nz)."""


class Gains(NamedTuple):
    """A backward pass of R trajectories: u = ubar + alpha k + K (x - xbar)."""

    k: Tensor  # (R, T, nu)
    K: Tensor  # (R, T, nu, 2nv)
    Q_uu: Tensor  # (R, T, nu, nu), not regularised
    d1: Tensor  # (R,) change of the cost that is predicted for alpha: alpha d1 + alpha^2 d2
    d2: Tensor
    ok: Tensor  # (R,) whether every Q_uu was positive definite


def symmetric(matrix: Tensor) -> Tensor:
    """The symmetric part of (..., n, n)."""
    return 0.5 * (matrix + matrix.mT)


def backward_pass(f_z: Tensor, gradient: Tensor, hessian: Tensor, mu: Tensor) -> Gains:
    """Dynamic programming with the state regularised by mu (R,) as of Tassa et al. 2012, from V = 0 at the end."""
    R, T, nd, nz = f_z.shape
    V_x, V_xx = f_z.new_zeros(R, nd, 1), f_z.new_zeros(R, nd, nd)
    eye = torch.eye(nz - nd, dtype=f_z.dtype, device=f_z.device)
    penalty = mu.view(-1, 1, 1, 1) * (f_z[..., nd:].mT @ f_z)
    penalty[..., nd:] += 1e-6 * mu.view(-1, 1, 1, 1) * eye  # for motors that move nothing
    ok = torch.ones(R, dtype=torch.bool, device=f_z.device)
    d1, d2 = torch.zeros_like(mu), torch.zeros_like(mu)
    steps = []
    for t in reversed(range(T)):
        f_t = f_z[:, t].mT
        q = gradient[:, t].unsqueeze(-1) + f_t @ V_x
        Q = hessian[:, t] + f_t @ V_xx @ f_t.mT
        regularised = Q[:, nd:] + penalty[:, t]
        factor, info = torch.linalg.cholesky_ex(symmetric(regularised[..., nd:]))
        ok = ok & (info == 0)
        factor = torch.where((info == 0)[:, None, None], factor, eye)
        gains = -torch.cholesky_solve(torch.cat((q[:, nd:], regularised[..., :nd]), -1), factor)
        k, K = gains[..., :1], gains[..., 1:]
        Q_uu, Q_ux, q_u = symmetric(Q[:, nd:, nd:]), Q[:, nd:, :nd], q[:, nd:]
        d1 = d1 + (k * q_u).sum((1, 2))
        d2 = d2 + 0.5 * (k * (Q_uu @ k)).sum((1, 2))
        # With unregularised Q, so that V is the value of these gains, whatever mu.
        V_x = q[:, :nd] + K.mT @ (Q_uu @ k + q_u) + Q_ux.mT @ k
        V_xx = symmetric(Q[:, :nd, :nd] + K.mT @ (Q_uu @ K + 2 * Q_ux))
        steps.append((k.squeeze(-1), K, Q_uu))
    k, K, Q_uu = (torch.stack(column[::-1], 1) for column in zip(*steps, strict=True))
    return Gains(k, K, Q_uu, d1, d2, ok)


class Plan(NamedTuple):
    """R trajectories."""

    x: Tensor  # (R, T + 1, nx)
    u: Tensor  # (R, T, nu)
    cost: Tensor  # (R,)


def follow(system: System, x: Tensor, u: Tensor, gains: Gains, alphas: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rollouts (R, A, ...) of R plans under their gains with A step sizes each, in one batch."""
    R, A = len(x), len(alphas)

    def act(t: int, state: Tensor) -> Tensor:
        tangent = system.difference(state.view(R, A, -1), x[:, None, t])
        feedback = (gains.K[:, None, t] @ tangent.unsqueeze(-1)).squeeze(-1)
        return (u[:, None, t] + alphas[:, None] * gains.k[:, None, t] + feedback).view(R * A, -1)

    xs, us, finite = system.rollout(x[:, 0].repeat_interleave(A, 0), u.shape[1], act)
    return xs.view(R, A, *xs.shape[1:]), us.view(R, A, *us.shape[1:]), finite.view(R, A, -1)


def step_jacobian(system: System, x: Tensor, u: Tensor) -> Tensor:
    """f_z (R, T, 2nv, 2nv + nu) of trajectories x (R, T + 1, nx), u (R, T, nu)."""
    f_z = system.jacobians(x[:, :-1].flatten(0, 1), u.flatten(0, 1))
    return f_z.view(*u.shape[:2], system.nd, -1)


def line_search(
    system: System, cost: Cost, x: Tensor, u: Tensor, total: Tensor, gains: Gains, moving: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The largest step that wins at least a hundredth of what the quadratic model promises, for each trajectory.

    Args:
        total: (R,) cost of the trajectories x (R, T + 1, nx), u (R, T, nu).
        moving: (R,) which ones may change.

    Returns:
        x, u and total after the step, and its size (R,): 0 where no step was good enough and all is as before.
    """
    alphas = ALPHAS.to(x.device)
    xs, us, finite = follow(system, x, u, gains, alphas)
    totals = torch.where(finite.all(-1), cost.value(xs, us).sum(-1), math.inf)
    expected = -(alphas * gains.d1[:, None] + alphas.square() * gains.d2[:, None])
    good = torch.isfinite(totals) & (total[:, None] - totals > 1e-2 * expected) & (expected > 0) & moving[:, None]
    accepted, choice = good.any(1), good.int().argmax(1)
    pick = torch.arange(len(x), device=x.device), choice
    x = torch.where(accepted[:, None, None], xs[pick], x)
    u = torch.where(accepted[:, None, None], us[pick], u)
    return x, u, torch.where(accepted, totals[pick], total), torch.where(accepted, alphas[choice], 0.0)


def change_mu(mu: Tensor, delta: Tensor, more: Tensor, less: Tensor) -> tuple[Tensor, Tensor]:
    """More regularisation for some, less for others: mu changes by delta, which itself grows each time in a row."""
    delta = torch.where(more, (delta * 1.6).clamp(min=1.6), delta)
    delta = torch.where(less, (delta / 1.6).clamp(max=1 / 1.6), delta)
    mu = torch.where(more, (mu * delta).clamp(min=1e-6), torch.where(less, mu * delta, mu))
    return torch.where(less & (mu < 1e-8), 0.0, mu), delta


@torch.no_grad()
def ilqr(system: System, cost: Cost, x: Tensor, u: Tensor, iterations: int, mu: float = 1.0) -> Plan:
    """Optimises R trajectories of the system, x (R, T + 1, nx) and u (R, T, nu), side by side.

    mu is the initial regularisation; each trajectory has its own.
    """
    total = cost.value(x.unsqueeze(1), u.unsqueeze(1)).sum(-1).squeeze(1)
    mus, delta = torch.full_like(total, mu), torch.ones_like(total)
    moving, fresh = torch.ones_like(total, dtype=torch.bool), True
    for _ in range(iterations):
        if fresh:
            f_z = step_jacobian(system, x, u)
            quadratic = cost.quadratic(x, u, f_z)
        gains = backward_pass(f_z, *quadratic, mus)
        while not bool((gains.ok | ~moving).all()):
            mus, delta = change_mu(mus, delta, ~gains.ok, torch.zeros_like(moving))
            moving = moving & (mus < 1e10)
            gains = backward_pass(f_z, *quadratic, mus)
        before = total
        x, u, total, step = line_search(system, cost, x, u, total, gains, moving)
        mus, delta = change_mu(mus, delta, step <= 0.01, step > 0.01)
        scale = 1 + total.abs()
        level, flat = gains.d1.abs() < 1e-7 * scale, (step > 0) & (before - total < 1e-6 * scale) & (mus < 1e-4)
        moving = moving & ~(level | flat | (mus > 1e10))
        fresh = bool((step > 0).any())
        if not bool(moving.any()):
            break
    return Plan(x, u, total)

"""Iterative LQR (Li and Todorov 2004): dynamic programming about trajectories, many of them side by side.

With Gauss-Newton's second derivatives (none of the dynamics), the state regularisation of Tassa, Erez and Todorov 2012
("Synthesis and stabilization of complex behaviors through online trajectory optimization"), and all step sizes of the
line search in one batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from diffsim.dynamics import REAL, Dynamics

ALPHAS = 0.5 ** torch.arange(11, dtype=REAL)  # step sizes of the line search


class Cost(Protocol):
    """What is minimised, of R trajectories of T steps."""

    @property
    def system(self) -> Dynamics: ...

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


def quadratic_after_step(
    system: Dynamics, loss: Callable[[Tensor, Tensor], Tensor], x: Tensor, u: Tensor, f_z: Tensor
) -> tuple[Tensor, Tensor]:
    """What Cost.quadratic wants, of a loss of (x_{t+1}, u_t): of each action and the state that it led to.

    Its derivatives come back through f_z, the Jacobian of the step, without second derivatives of the dynamics.
    """
    nd, nz = f_z.shape[-2:]
    d = u.new_zeros(*u.shape[:2], nz, requires_grad=True)
    with torch.enable_grad():
        total = loss(system.retract(x[:, 1:], d[..., :nd]), u + d[..., nd:]).sum()
        (g,) = torch.autograd.grad(total, d, create_graph=True)
        rows = [torch.autograd.grad(g[..., i].sum(), d, retain_graph=True)[0] for i in range(nz)]
    # The joint Hessian is made positive, not its blocks: the cross terms would break them again.
    values, vectors = torch.linalg.eigh(symmetric(torch.stack(rows, -2)))
    h = (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT
    actions = torch.eye(nz, dtype=f_z.dtype, device=f_z.device)[nd:].expand(*u.shape[:2], -1, -1)
    y_z = torch.cat((f_z, actions), -2)
    return (y_z.mT @ g.detach().unsqueeze(-1)).squeeze(-1), y_z.mT @ h @ y_z


class Plan(NamedTuple):
    """R trajectories."""

    x: Tensor  # (R, T + 1, nx)
    u: Tensor  # (R, T, nu)
    cost: Tensor  # (R,)
    note: list[str]  # why each ended


def follow(system: Dynamics, x: Tensor, u: Tensor, gains: Gains, alphas: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rollouts (R, A, ...) of R plans under their gains with A step sizes each, in one batch."""
    R, A = len(x), len(alphas)

    def act(t: int, state: Tensor) -> Tensor:
        tangent = system.difference(state.view(R, A, -1), x[:, None, t])
        feedback = (gains.K[:, None, t] @ tangent.unsqueeze(-1)).squeeze(-1)
        return (u[:, None, t] + alphas[:, None] * gains.k[:, None, t] + feedback).view(R * A, -1)

    xs, us, finite = system.rollout(x[:, 0].repeat_interleave(A, 0), u.shape[1], act)
    return xs.view(R, A, *xs.shape[1:]), us.view(R, A, *us.shape[1:]), finite.view(R, A, -1)


def step_jacobian(system: Dynamics, x: Tensor, u: Tensor) -> Tensor:
    """f_z (R, T, 2nv, 2nv + nu) of trajectories x (R, T + 1, nx), u (R, T, nu)."""
    flat = [tensor.flatten(0, 1) for tensor in (x[:, :-1], u, x[:, 1:])]
    return system.jacobians(*flat).view(*u.shape[:2], system.nd, -1)


@torch.no_grad()
def ilqr(
    cost: Cost,
    x: Tensor,
    u: Tensor,
    iterations: int,
    mu: float = 1.0,
    show: Callable[[int, Tensor], None] | None = None,
) -> Plan:
    """Optimises R trajectories side by side, each with its own regularisation.

    Args:
        cost: what is minimised.
        x: (R, T + 1, nx) trajectories of cost.system.
        u: (R, T, nu) their actions.
        iterations: at most so many.
        mu: initial regularisation.
        show: called as show(iteration, costs (R,)) after each iteration.
    """
    system, alphas, R = cost.system, ALPHAS.to(x.device), len(x)
    best = cost.value(x.unsqueeze(1), u.unsqueeze(1)).sum(-1).squeeze(1)
    mus, delta = torch.full_like(best, mu), torch.ones_like(best)
    moving, note, fresh = torch.ones_like(best, dtype=torch.bool), ["iterations"] * R, True
    for iteration in range(iterations):
        if fresh:
            f_z = step_jacobian(system, x, u)
            quadratic = cost.quadratic(x, u, f_z)
        gains = backward_pass(f_z, *quadratic, mus)
        while not bool((gains.ok | ~moving).all()):  # raise mu where Q_uu was not positive definite
            delta = torch.where(gains.ok, delta, (delta * 1.6).clamp(min=1.6))
            mus = torch.where(gains.ok, mus, (mus * delta).clamp(min=1e-6))
            moving = moving & (mus < 1e10)
            gains = backward_pass(f_z, *quadratic, mus)
        xs, us, finite = follow(system, x, u, gains, alphas)
        costs = torch.where(finite.all(-1), cost.value(xs, us).sum(-1), math.inf)
        expected = -(alphas * gains.d1[:, None] + alphas.square() * gains.d2[:, None])
        good = torch.isfinite(costs) & (best[:, None] - costs > 1e-2 * expected) & (expected > 0) & moving[:, None]
        accepted, choice = good.any(1), good.int().argmax(1)  # the largest step size that is good
        pick = torch.arange(R, device=x.device), choice
        gain = torch.where(accepted, best - costs[pick], 0.0)
        x = torch.where(accepted[:, None, None], xs[pick], x)
        u = torch.where(accepted[:, None, None], us[pick], u)
        best = torch.where(accepted, costs[pick], best)
        raised = ~accepted | (alphas[choice] <= 0.01)
        delta = torch.where(raised, (delta * 1.6).clamp(min=1.6), (delta / 1.6).clamp(max=1 / 1.6))
        mus = torch.where(raised, (mus * delta).clamp(min=1e-6), mus * delta)
        mus = torch.where(mus < 1e-8, 0.0, mus)
        ends = {
            "gradient": gains.d1.abs() < 1e-7 * (1 + best.abs()),
            "cost": accepted & (gain < 1e-6 * (1 + best.abs())) & (mus < 1e-4),
            "regularisation": mus > 1e10,
        }
        for name, mask in ends.items():
            for r in (mask & moving).nonzero().flatten().tolist():
                note[r] = name
            moving = moving & ~mask
        if show:
            show(iteration, best)
        fresh = bool(accepted.any())
        if not bool(moving.any()):
            break
    return Plan(x, u, best, note)


def starting_actions(count: int, steps: int, nu: int, dt: float, rng: torch.Generator) -> Tensor:
    """Where to start from: (count, steps, nu) nothing, then by turns a sinusoid per motor, a random walk, white noise.

    dt is the control step in seconds; rng is on the CPU, as the result.
    """
    t = dt * torch.arange(steps, dtype=REAL).view(-1, 1)
    result = [torch.zeros(steps, nu, dtype=REAL)]
    for i in range(1, count):
        amplitude = torch.rand(1, nu, generator=rng, dtype=REAL)
        if i % 3 == 1:
            frequency, phase = torch.rand(2, 1, nu, generator=rng, dtype=REAL)
            result.append(amplitude * torch.sin(2 * math.pi * (2.0 * frequency * t + phase)))
        else:
            white = torch.randn(steps, nu, generator=rng, dtype=REAL)
            result.append(amplitude * (white.cumsum(0) * dt**0.5 if i % 3 == 2 else 0.5 * white))
    return torch.stack(result[:count])

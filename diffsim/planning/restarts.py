"""Trajectory optimisation from nothing: many random action sequences, of which the best are kept and continued."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.planning.ilqr import Cost, Show, ilqr
from diffsim.planning.system import REAL, System


def starting_actions(count: int, steps: int, nu: int, dt: float, rng: torch.Generator) -> Tensor:
    """Where to start from: (count, steps, nu) nothing, then by turns a wave, a random walk and white noise, on the CPU.

    The motors of a wave have one frequency of 0.5 to 8 Hz; dt is the control step in seconds.
    """
    t = dt * torch.arange(steps, dtype=REAL).view(-1, 1)
    result = [torch.zeros(steps, nu, dtype=REAL)]
    for i in range(1, count):
        amplitude = torch.rand(1, nu, generator=rng, dtype=REAL)
        if i % 3 == 1:
            octaves, phase = 4 * torch.rand(1, generator=rng, dtype=REAL), torch.rand(1, nu, generator=rng, dtype=REAL)
            result.append(amplitude * torch.sin(2 * math.pi * (0.5 * 2**octaves * t + phase)))
        else:
            white = torch.randn(steps, nu, generator=rng, dtype=REAL)
            result.append(amplitude * (white.cumsum(0) * dt**0.5 if i % 3 == 2 else 0.5 * white))
    return torch.stack(result[:count])


def best_of_random_starts(
    system: System, cost: Cost, start: Tensor, actions: Tensor, keep: int, iterations: int, show: Show | None = None
) -> tuple[Tensor, Tensor]:
    """Optimises trajectories from one state (nx,), side by side and for a few iterations; see ilqr.

    Args:
        actions: (R, T, nu) where to start from, see starting_actions; those that diverge are left out.

    Returns:
        x (keep, T + 1, nx), u (keep, T, nu), the cheapest first; fewer if fewer are left.

    Raises:
        ValueError: all of them diverged.
    """
    x, u, finite = system.rollout(start.expand(len(actions), -1), actions.shape[1], lambda t, _: actions[:, t])
    whole = finite.all(1)
    if not bool(whole.any()):
        raise ValueError("every random start of the planner left the finite numbers: give more substeps")
    plan = ilqr(system, cost, x[whole], u[whole], iterations, show=show)
    best = plan.cost.argsort()[:keep]
    return plan.x[best], plan.u[best]


def receding_horizon(
    system: System, cost: Cost, x: Tensor, u: Tensor, steps: int, advance: int, iterations: int, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Continues optimised first windows x (R, W + 1, nx), u (R, W, nu) to x (R, T + 1, nx), u (R, T, nu), T = steps.

    Over a long horizon most random starts fall, and what comes after a fall has no useful gradient. A window ends soon
    enough for a few actions to prevent the fall. Each begins `advance` steps after the one before, at most W / 2. Its
    new actions begin as none, the last one, the last ones repeated, and noise from rng, on the CPU. The cheapest of the
    four optima after so many iterations of iLQR is kept.
    """
    (R, W, nu), done, xs, us = u.shape, 0, list[Tensor](), list[Tensor]()
    while done + W < steps:
        xs, us, done = [*xs, x[:, :advance]], [*us, u[:, :advance]], done + advance
        noise = torch.randn(R, advance, nu, generator=rng, dtype=REAL).to(u.device)
        ends = 0 * noise, u[:, -1:].expand(-1, advance, -1), u[:, -advance:], 0.3 * noise
        u = torch.cat([torch.cat((u[:, advance:], end), 1) for end in ends])
        x, u, finite = system.rollout(x[:, advance].repeat(4, 1), W, lambda t, _, u=u: u[:, t])  # type: ignore[misc]
        plan = ilqr(system, cost, x, u, iterations)
        total = torch.where(finite.all(1), plan.cost, math.inf).view(4, R)
        best = total.argmin(0) * R + torch.arange(R, device=u.device)
        x, u = plan.x[best], plan.u[best]
    return torch.cat((*xs, x), 1)[:, : steps + 1], torch.cat((*us, u), 1)[:, :steps]

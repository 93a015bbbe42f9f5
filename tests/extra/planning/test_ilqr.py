"""Iterative LQR against dense solutions of linear-quadratic problems."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from systems import Linear, normal
from torch import Tensor

from diffsim.extra.planning import AfterStep, backward_pass, follow, ilqr, step_jacobian


def test_a_linear_system_is_solved_by_least_squares(rng: np.random.Generator) -> None:
    """One full step, whose gain is the predicted one; the feedback is right too: from any other start."""
    system, T = Linear(rng), 12
    x, u = system.unforced(normal(rng, 2, 3), T)
    plan = ilqr(system, system.cost, x, u, 1, mu=0.0)
    f_z = step_jacobian(system, x, u)
    gains = backward_pass(f_z, *system.cost.quadratic(x, u, f_z), torch.zeros(2).double())
    before = system.cost.value(x, u).sum(-1)
    torch.testing.assert_close((plan.cost - before) / (gains.d1 + gains.d2), torch.ones(2).double(), rtol=1e-8, atol=0)

    def solution(start: Tensor) -> Tensor:
        gradient, hessian = system.dense(T, start)
        return -torch.linalg.solve(hessian, gradient).view(T, -1)

    for r in range(2):
        torch.testing.assert_close(plan.u[r], solution(x[r, 0]), rtol=1e-10, atol=1e-10)
    other = normal(rng, 1, 3)
    _, actions, _ = system.rollout(
        other, T, lambda t, state: u[:1, t] + gains.k[:1, t] + (state - x[:1, t]) @ gains.K[0, t].mT
    )
    torch.testing.assert_close(actions[0], solution(other[0]), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("mu, alphas", [(3.0, [1.0]), (0.0, [1.0, 0.5, 0.1])])
def test_value_of_gains_is_what_they_cost(mu: float, alphas: list[float], rng: np.random.Generator) -> None:
    """The short form of the value update is wrong for mu > 0; the general one predicts the cost of the full step with
    any gains. Of shorter steps only with optimal ones: others feed back the difference to a path not taken."""
    system = Linear(rng)
    x, u = system.unforced(normal(rng, 1, 3), 6)
    f_z = step_jacobian(system, x, u)
    gains = backward_pass(f_z, *system.cost.quadratic(x, u, f_z), torch.tensor([mu]).double())
    sizes = torch.tensor(alphas).double()
    xs, us, _ = follow(system, x, u, gains, sizes)
    change = system.cost.value(xs, us).sum(-1)[0] - system.cost.value(x, u).sum()
    torch.testing.assert_close(change, sizes * gains.d1 + sizes**2 * gains.d2, rtol=1e-10, atol=1e-10)


def test_an_indefinite_cost_raises_mu_and_ends_without_an_exception(rng: np.random.Generator) -> None:
    system = Linear(rng)
    hill = AfterStep(system, lambda x, u: (0.1 * u.square()).sum(-1) + (x.square().sum(-1) - 1).square())
    x, u = system.unforced(normal(rng, 2, 3), 10)
    plan = ilqr(system, hill, x, u, 60)
    assert (plan.cost < 0.5 * hill.value(x, u).sum(-1)).all()
    torch.testing.assert_close(hill.value(plan.x, plan.u).sum(-1), plan.cost)

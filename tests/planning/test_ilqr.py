"""Planners against closed forms: iterative LQR, the controllers that it leaves, and L-BFGS."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from systems import Linear, normal
from torch import Tensor

from diffsim.planning import (
    AfterStep,
    backward_pass,
    follow,
    gaussian_log_prob,
    ilqr,
    maximum_entropy_controllers,
    step_jacobian,
)
from diffsim.planning.lbfgs import maximise

# Iterative LQR --------------------------------------------------------------------------------------------------------


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


# Controllers ----------------------------------------------------------------------------------------------------------


def test_the_maximum_entropy_controller(rng: np.random.Generator) -> None:
    """Q_uu^-1, with Q_uu the Schur complement of the dense cost to go, from the present action to the end."""
    system, T = Linear(rng), 8
    plan = ilqr(system, system.cost, *system.unforced(normal(rng, 1, 3), T), 3, mu=0.0)
    (controller,) = maximum_entropy_controllers(system, system.cost, plan)
    for t in range(T):
        _, hessian = system.dense(T - t, plan.x[0, t])
        q_uu = torch.linalg.inv(torch.linalg.inv(hessian)[:2, :2])  # the rest minimised out
        covariance = controller.L[t] @ controller.L[t].mT
        torch.testing.assert_close(covariance, torch.linalg.inv(q_uu), rtol=1e-8, atol=1e-12)
    assert controller.mu == 0

    noise = normal(rng, 40_000, 2, 2)
    short = controller._replace(x=controller.x[:3], u=controller.u[:2], K=controller.K[:2], L=controller.L[:2])
    x, u, _ = short.sample(system, noise)
    torch.testing.assert_close(torch.cov(u[:, 0].mT), short.L[0] @ short.L[0].mT, rtol=0.05, atol=2e-4)
    torch.testing.assert_close(short.mean(system, 1, x[:, 1]), short.mean(system, slice(0, 2), x[:, :2])[:, 1])
    expected = torch.distributions.MultivariateNormal(torch.zeros(2).double(), scale_tril=short.L)
    log_prob = expected.log_prob(torch.einsum("tij,mtj->mti", short.L, noise))
    torch.testing.assert_close(short.log_prob(system, x, u), log_prob, rtol=1e-9, atol=1e-9)


def test_log_density_of_independent_normals(rng: np.random.Generator) -> None:
    u, mean, sigma = normal(rng, 4, 5, 2), normal(rng, 4, 5, 2), torch.tensor([0.3, 2.0]).double()
    expected = torch.distributions.Normal(mean, sigma).log_prob(u).sum(-1)
    torch.testing.assert_close(gaussian_log_prob(u, mean, sigma), expected)


# L-BFGS ---------------------------------------------------------------------------------------------------------------


def test_the_best_finite_point_is_returned() -> None:
    start = torch.full((2,), 0.9, dtype=torch.float64)
    best, value = maximise(lambda theta: (1 - theta.square().sum()).log(), start / 2, 30)  # NaN outside of a circle
    assert abs(value) < 1e-8 and best.abs().max() < 1e-4
    best, value = maximise(lambda theta: -theta.sum() * math.nan, start, 5)
    assert torch.equal(best, start) and value == -math.inf


def test_a_quadratic_is_solved() -> None:
    root = torch.tensor([[2.0, 0.0, 0.0], [1.0, 0.5, 0.0], [-1.0, 3.0, 0.1]]).double()
    target = torch.tensor([1.0, -2.0, 3.0]).double()
    best, value = maximise(lambda theta: -(root @ (theta - target)).square().sum(), torch.zeros(3).double(), 50)
    torch.testing.assert_close(best, target, rtol=1e-5, atol=1e-5)
    assert abs(value) < 1e-10

"""The terms of a cost: values, derivatives through the step against differences, and what they make a planner do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from systems import normal, one_step, random_states, task_system
from torch import Tensor

from diffsim.planning import AfterStep, Cost, Sum, Surprisal, System, Tracking, ilqr, maximum_entropy_controllers
from diffsim.planning.ilqr import step_jacobian


def mean(x: Tensor) -> Tensor:
    """Of a policy of cartpole's state."""
    return 0.5 * torch.tanh(x @ torch.tensor([[0.1], [-0.3], [0.2], [0.1]]).double() + 0.2)


def check_quadratic(system: System, cost: Cost, start: Tensor, u: Tensor, rng: np.random.Generator) -> None:
    """Gradient in (x_t, u_t), through the step, against central differences of the value."""
    x = torch.stack((start, one_step(system, start, u)), 1)
    gradient, hessian = cost.quadratic(x, u[:, None], step_jacobian(system, x, u[:, None]))
    assert torch.linalg.eigvalsh(hessian).min() > -1e-6 * hessian.abs().max()
    eps = 1e-6
    for d in normal(rng, 4, system.nd + system.nu):

        def value(s: float, d: Tensor = d) -> Tensor:
            at, action = system.retract(start, s * d[: system.nd].expand(3, -1)), u + s * d[system.nd :]
            path = torch.stack((at, one_step(system, at, action)), 1)
            return cost.value(path[:, None], action[:, None, None])[:, 0, 0]

        slope = (value(eps) - value(-eps)) / (2 * eps)
        torch.testing.assert_close(gradient[:, 0] @ d, slope, rtol=1e-4, atol=1e-4 * slope.abs().max().item())


@pytest.mark.parametrize("name", ["cartpole", "hopper", pytest.param("ant", marks=pytest.mark.slow)])
def test_quadratic_of_a_reward_after_the_step(name: str, rng: np.random.Generator) -> None:
    system = task_system(name)
    reward = AfterStep(system, lambda x, u: -system.reward(x, u))
    check_quadratic(system, reward, *random_states(system, rng, 3), rng)


def test_quadratic_of_a_sum_of_terms(rng: np.random.Generator) -> None:
    system = task_system("cartpole")
    x, u = random_states(system, rng, 3)
    tracking = Tracking(system, normal(rng, 3, 2, 4), normal(rng, 3, 1, 1), 0.3, torch.tensor([0.7]).double())
    check_quadratic(system, tracking, x, u, rng)
    check_quadratic(system, Sum((tracking, AfterStep(system, lambda x, u: -system.reward(x, u)))), x, u, rng)
    surprisal = Surprisal(system, mean, torch.tensor([0.3]).double())
    check_quadratic(system, Sum((surprisal, tracking)), x, u, rng)
    path = x[:, None, None].expand(3, 1, 2, 4)
    parts = [term.value(path, u[:, None, None]) for term in (surprisal, tracking)]
    torch.testing.assert_close(Sum((surprisal, tracking)).value(path, u[:, None, None]), sum(parts))


def test_a_plan_of_surprisal_alone_is_the_policy() -> None:
    """The I-projection of pi is its linearisation, with its covariance (Levine and Koltun 2013, section 4.2, r = 0)."""
    system, sigma = task_system("cartpole"), torch.tensor([0.2], dtype=torch.float64)
    start = torch.tensor([[0.1, 2.0, 0.3, -0.2]]).double()
    x, u, _ = system.rollout(start, 20, lambda t, _: torch.full((1, 1), 0.3).double())
    cost = Surprisal(system, mean, sigma)
    plan = ilqr(system, cost, x, u, 50, mu=0.0)
    (controller,) = maximum_entropy_controllers(system, cost, plan)
    torch.testing.assert_close(controller.u, mean(controller.x[:-1]), rtol=0, atol=1e-6)
    torch.testing.assert_close(controller.L, torch.full_like(controller.L, 0.2), rtol=1e-8, atol=0)
    slopes = torch.func.vmap(torch.func.jacrev(mean))(controller.x[:-1])
    torch.testing.assert_close(controller.K, slopes, rtol=1e-6, atol=1e-6)

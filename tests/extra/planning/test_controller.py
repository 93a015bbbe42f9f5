"""Linear-Gaussian controllers against the closed form of a linear-quadratic problem."""

from __future__ import annotations

import numpy as np
import torch
from systems import Linear, normal

from diffsim.extra.planning import gaussian_log_prob, ilqr, maximum_entropy_controllers


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

"""Linear-Gaussian controllers against the closed form of a linear-quadratic problem."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from systems import Linear, normal, task_system

from diffsim.planning import (
    LinearGaussian,
    gaussian_log_prob,
    ilqr,
    maximum_entropy_controllers,
    nearest_feedback,
)


def test_the_maximum_entropy_controller(rng: np.random.Generator) -> None:
    """eta Q_uu^-1, with Q_uu the Schur complement of the dense cost to go, from the present action to the end."""
    system, T, sigma = Linear(rng), 8, torch.tensor([0.3, 0.2]).double()
    plan = ilqr(system, system.cost, *system.unforced(normal(rng, 1, 3), T), 3, mu=0.0)
    (controller,) = maximum_entropy_controllers(system, system.cost, plan, sigma, 1.0)
    stds = []
    for t in range(T):
        _, hessian = system.dense(T - t, plan.x[0, t])
        q_uu = torch.linalg.inv(torch.linalg.inv(hessian)[:2, :2])  # the rest minimised out
        covariance = controller.L[t] @ controller.L[t].mT
        torch.testing.assert_close(covariance, controller.eta * torch.linalg.inv(q_uu), rtol=1e-8, atol=1e-12)
        stds.append(covariance.diagonal().sqrt())
    ratio = torch.stack(stds).median(0).values / sigma
    assert ratio.max() == pytest.approx(1.0, rel=1e-6) and controller.mu == 0  # one eta, of the tightest motor

    (wide,) = maximum_entropy_controllers(system, system.cost, plan, sigma, 0.0)
    assert wide.eta == 1.0  # the temperature of exp(-cost)
    torch.testing.assert_close(wide.L * controller.eta.sqrt(), controller.L)

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


def test_feedback_is_that_of_the_step_that_looks_most_alike(rng: np.random.Generator) -> None:
    """Of any guide, whatever the time, and wherever a hopper is along x, which it does not observe."""
    system = task_system("hopper")
    guides = []
    for _ in range(2):
        x, u, K = 0.1 * normal(rng, 6, 12), normal(rng, 5, 3), normal(rng, 5, 3, 12)
        guides.append(LinearGaussian(x, u, K, normal(rng, 5, 3, 3), x[0, 0], x[0, 0]))
    d = 1e-3 * normal(rng, 4, 12)
    d[:, 0] = 10.0
    (i, t), scale = ((0, 1, 1, 0), (4, 0, 3, 2)), torch.full((system.observed.shape[0],), 2.0).double()
    x, mean, L = (
        torch.stack([part(guides[j], k, d[row]) for row, (j, k) in enumerate(zip(i, t, strict=True))])
        for part in (
            lambda g, k, d: g.x[k] + d,
            lambda g, k, d: g.u[k] + g.K[k] @ d,
            lambda g, k, _: g.L[k],
        )
    )
    u, factor, distance = nearest_feedback(system, guides, x, scale)
    torch.testing.assert_close(u, mean)
    assert torch.equal(factor, L)
    at = torch.stack([guides[j].x[k] for j, k in zip(i, t, strict=True)])
    expected = ((system.observe(x) - system.observe(at)) / 2).square().mean(1).sqrt()
    torch.testing.assert_close(distance, expected)


def test_a_mean_of_the_controllers_that_are_near(rng: np.random.Generator) -> None:
    """Of each its nearest step, within the bound, with weights that fall with the squared distance."""
    system = task_system("hopper")
    guides, starts = [], system.start() + 0.2 * normal(rng, 3, 1, 12)
    for x in starts:
        u = 5.0 * normal(rng, 2, 3)
        L = normal(rng, 2, 3, 3)
        guides.append(LinearGaussian(torch.cat((x, x + 9.0, x)), u, normal(rng, 2, 3, 12), L, u.sum(), u.sum()))
    x, scale = starts[1] + 0.05 * normal(rng, 4, 12), torch.full((len(system.observed),), 0.5).double()
    distance = ((system.observe(x) - system.observe(starts)) / 0.5).square().mean(2).sqrt()  # (3, 4)
    actions = torch.stack([(g.u[0] + (x - g.x[0]) @ g.K[0].mT).clamp(-2, 2) for g in guides])
    weight = torch.exp(-((distance / 0.4) ** 2))
    u, L, nearest = nearest_feedback(system, guides, x, scale, 2.0, 0.4)
    torch.testing.assert_close(u, (weight.unsqueeze(2) * actions).sum(0) / weight.sum(0).unsqueeze(1))
    assert weight.sum(0).min() > 0 and (weight / weight.sum(0)).max() < 0.999
    best = distance.argmin(0)
    torch.testing.assert_close(nearest, distance.min(0).values)
    assert torch.equal(L, torch.stack([guides[i].L[0] for i in best]))
    hard = nearest_feedback(system, guides, x, scale, 2.0)[0]
    torch.testing.assert_close(hard, actions[best, torch.arange(4)])

"""RPO's steps against SHAC's, its surrogate against differences, and its bounds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_derivatives

import diffsim
import rpo
import shac
from diffsim.training import parse

SMALL = "--env hopper --horizon 8 --num-envs 4 --device cpu --actor-hidden 16 8 --critic-hidden 8".split()
SAME = "--critic-lr 1e-3 --target-alpha 0.5 --critic-iterations 2".split()


def build(script: Any, name: str, *flags: str) -> Any:
    args = parse(script.Args, [*SMALL, *SAME, *flags])
    torch.manual_seed(args.seed)
    learner = getattr(script, name)(args, diffsim.make("hopper", num_envs=4, seed=1, horizon=8))
    for optimizer in (learner.actor_optimizer, learner.critic_optimizer):
        optimizer.lr.fill_(1e-3)
    return learner


@pytest.mark.parametrize("bound", ["distance", "ratio"])
def test_with_one_step_an_iteration_is_that_of_shac(bound: str) -> None:
    ours, theirs = build(rpo, "RPO", "--epochs", "1", "--minibatches", "1", "--bound", bound), build(shac, "SHAC")
    for learner in (ours, theirs):
        torch.manual_seed(1)
        learner.iterate()
    mine, other = (learner.actor_optimizer.exp_avg for learner in (ours, theirs))  # Adam takes signs of what is tiny
    assert (mine - other).norm() < 1e-5 * other.norm() > 0.0
    torch.testing.assert_close(ours.critic_optimizer.vector, theirs.critic_optimizer.vector)


def samples(learner: Any, rng: np.random.Generator) -> tuple[rpo.Samples, torch.Tensor]:
    """Random samples of an actor in float64 that has moved since, and the deviation of their noise."""
    learner.actor.double()
    obs, eps, slope = (torch.tensor(rng.normal(size=(8, 4, n))) for n in (11, 3, 3))
    with torch.no_grad():
        mean = learner.actor.mean(obs) + 0.02 * torch.tensor(rng.normal(size=eps.shape))
    return rpo.Samples(obs, eps, mean, slope), torch.tensor(rng.uniform(0.3, 0.4, 3))


@pytest.mark.parametrize("flags", ["--trust 100", "--trust 0.05", "--trust 100 --kl-coef 0.3"])
def test_the_surrogate_has_the_gradient_of_its_differences(rng: np.random.Generator, flags: str) -> None:
    learner = build(rpo, "RPO", *flags.split())
    batch, std = samples(learner, rng)
    weights = dict(learner.actor.named_parameters())
    places = [(name, int(rng.integers(weight.numel()))) for name, weight in weights.items() for _ in range(4)]
    assert_derivatives(weights, lambda: learner.surrogate(batch, std), places, rel=1e-5)


def test_with_the_ratio_the_gradient_is_that_of_the_density_and_the_slope(rng: np.random.Generator) -> None:
    """Of the paper: sum of ratio g du/dtheta, with the noise that gives the rollout's action today."""
    learner = build(rpo, "RPO", "--bound", "ratio", "--trust", "0.5")
    batch, std = samples(learner, rng)
    mean, today = learner.actor.mean(batch.obs), learner.actor.log_std.exp()
    action = batch.mean + std * batch.eps
    densities = [
        torch.distributions.Normal(m, s).log_prob(action).sum(-1) for m, s in ((mean, today), (batch.mean, std))
    ]
    ratio = (densities[0] - densities[1]).exp().detach()
    inside = (ratio - 1).abs() < 0.5
    assert inside.any() and not inside.all()
    per_action = (ratio * inside).unsqueeze(-1) * batch.slope
    expected = torch.autograd.grad(
        (per_action * mean).sum() + (per_action * (action - mean).detach() / today.detach() * today).sum(),
        (*learner.actor.mean.parameters(), learner.actor.log_std),
    )
    found = torch.autograd.grad(
        learner.surrogate(batch, std), (*learner.actor.mean.parameters(), learner.actor.log_std)
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_an_action_moves_downhill_to_the_bound_and_back_from_beyond_it_uphill() -> None:
    learner = build(rpo, "RPO", "--trust", "0.5")
    slope, std = torch.tensor([1.0, 1.0, 1.0, -1.0]), torch.full((1,), 0.2)
    moves = torch.tensor([-0.11, -0.09, 0.3, 0.11], requires_grad=True)  # beyond it downhill, within, uphill, beyond
    learner.actor = SimpleNamespace(mean=lambda obs: moves, log_std=std.log())
    zero = torch.zeros(4)
    loss = learner.surrogate(rpo.Samples(zero, zero, zero, slope), std)
    torch.testing.assert_close(torch.autograd.grad(loss, moves)[0], torch.tensor([0.0, 1.0, 1.0, 0.0]))


def test_the_deviation_moves_once_and_the_mean_many_times() -> None:
    once, often = (
        build(rpo, "RPO", "--epochs", "1", "--minibatches", "1"),
        build(rpo, "RPO", "--epochs", "5", "--minibatches", "1"),
    )
    for learner in (once, often):
        torch.manual_seed(1)
        learner.iterate()
    assert torch.equal(once.actor.log_std, often.actor.log_std)
    start = build(rpo, "RPO").actor_optimizer.vector
    near, far = ((learner.actor_optimizer.vector - start).norm() for learner in (once, often))
    assert far > 2 * near


def test_the_second_term_is_the_divergence_from_the_rollouts_policy(rng: np.random.Generator) -> None:
    learner = build(rpo, "RPO", "--kl-coef", "0.3")
    batch, std = samples(learner, rng)
    with_term = learner.surrogate(batch, std)
    learner.args.kl_coef = 0.0
    today = torch.distributions.Normal(learner.actor.mean(batch.obs), learner.actor.log_std.exp())
    kl = torch.distributions.kl_divergence(torch.distributions.Normal(batch.mean, std), today).sum(-1).mean()
    torch.testing.assert_close(with_term - learner.surrogate(batch, std), 0.3 * kl)


def test_minibatches_have_the_gradient_of_all_samples_on_average(rng: np.random.Generator) -> None:
    learner = build(rpo, "RPO", "--epochs", "1", "--minibatches", "2")
    batch, std = samples(learner, rng)
    optimizer, taken = learner.actor_optimizer, list[torch.Tensor]()
    whole = optimizer.gradient(learner.surrogate(batch, std))

    def keep(gradient: torch.Tensor) -> torch.Tensor:
        taken.append(gradient)
        return gradient.norm()

    optimizer.step = keep
    learner.improve(batch, std)
    assert len(taken) == 2
    torch.testing.assert_close(torch.stack(taken).mean(0), whole)

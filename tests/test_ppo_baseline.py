"""PPO's parts against plain reference implementations."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import read_progress, run
from problems import lambda_returns
from torch.distributions import Normal, kl_divergence

import diffsim
import ppo_baseline as ppo
from diffsim.training import parse


@pytest.mark.parametrize("lam", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("horizon", [1, 12])
def test_gae_is_the_weighted_sum_of_all_its_n_step_advantages(
    rng: np.random.Generator, lam: float, horizon: int
) -> None:
    """Schulman et al. 2016, Eq. 11-16, with ends of both kinds at random."""
    gamma, size = 0.97, (horizon, 50)
    kind = rng.choice(3, size=size, p=(0.8, 0.1, 0.1))
    terminated, done = kind == 1, kind > 0
    reward, value, following = (rng.normal(size=size) for _ in range(3))
    following[terminated] = 0.0  # V(s_{t+1}): of the last state where time ran out, nothing where the episode failed
    for t, i in zip(*np.nonzero(~done[:-1]), strict=True):
        following[t, i] = value[t + 1, i]
    expected = lambda_returns(reward, following, done, gamma, lam) - value
    tensors = (torch.tensor(x) for x in (reward, value, following, done))
    np.testing.assert_allclose(ppo.gae(*tensors, gamma, lam), expected, rtol=1e-12, atol=1e-12)


def test_samples_of_a_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three ants that run out of time, fall, and do neither. Advantages are of values in the rewards' units: of the
    last states before any reset, zero after a termination; both are normalized for the update.
    """
    torch.manual_seed(0)
    args = parse(ppo.Args, "--env ant --device cpu --horizon 8 --hidden 16".split())
    env = diffsim.make("ant", num_envs=3, seed=0, horizon=8)
    learner = ppo.PPO(args, env)
    policy = learner.actor_critic
    learner.return_normalizer.update(5.0 + 3.0 * torch.randn(50))
    policy.normalizer.update(torch.randn(50, 37))
    normalizer, returns = copy.deepcopy(policy.normalizer), copy.deepcopy(learner.return_normalizer)
    env.episode_step[1] = env.episode_length - 4
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    qpos[2, 2], qvel[2, 2] = 0.3, -6.0
    env.set_state(qpos, qvel)
    made, collect = list[tuple[ppo.Rollout, torch.Tensor]](), ppo.collect

    def recorded(env: Any, policy: Any, noise: torch.Tensor) -> ppo.Rollout:
        made.append((collect(env, policy, noise), noise))
        return made[-1][0]

    monkeypatch.setattr(ppo, "collect", recorded)
    batch, _ = learner.act()
    ((rollout, noise),) = made
    truncated = rollout.done & ~rollout.terminated
    assert truncated.nonzero().tolist() == [[3, 1]] and rollout.terminated.any(0).tolist() == [False, False, True]
    assert not any(tensor.requires_grad for tensor in rollout)
    same = rollout.next_obs[:-1] == rollout.obs[1:]
    torch.testing.assert_close(same.all(-1), ~rollout.done[:-1])
    with torch.no_grad():
        (mean, value), (_, next_value) = (policy(normalizer(obs)) for obs in (rollout.obs, rollout.next_obs))
    torch.testing.assert_close(rollout.mean, mean)
    torch.testing.assert_close(rollout.value, value)
    torch.testing.assert_close(rollout.action, mean + policy.log_std.exp() * noise)

    value, next_value = returns.inverse(value), returns.inverse(next_value).masked_fill(rollout.terminated, 0.0)
    advantage = ppo.gae(rollout.reward, value, next_value, rollout.done, args.gamma, ppo.GAE_LAMBDA)
    returns.update(value + advantage)
    torch.testing.assert_close(batch.obs, normalizer(rollout.obs).flatten(0, 1))
    torch.testing.assert_close(batch.target, returns((value + advantage).flatten()), rtol=1e-4, atol=1e-5)
    flat = advantage.flatten()
    torch.testing.assert_close(batch.advantage, (flat - flat.mean()) / flat.std(correction=0), rtol=1e-4, atol=1e-5)
    assert policy.normalizer.count == 50 + 24 and learner.return_normalizer.count == 50 + 24
    torch.testing.assert_close(policy.deterministic()(rollout.obs), policy(policy.normalizer(rollout.obs))[0])


def gaussians(count: int = 40) -> tuple[ppo.Batch, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A batch acted by one policy, and mean, log_std of another, and the first one's log_std."""
    torch.manual_seed(0)
    mean, other = torch.randn(2, count, 3, dtype=torch.float64)
    log_std, old_log_std = 0.3 * torch.randn(2, 3, dtype=torch.float64)
    action = mean + old_log_std.exp() * torch.randn_like(mean)
    batch = ppo.Batch(
        torch.zeros(count, 1),
        mean,
        action,
        torch.randn(count, dtype=torch.float64),
        torch.zeros(count),
    )
    return batch, other, log_std, old_log_std


def test_ratio_and_divergence_are_those_of_the_distributions() -> None:
    batch, mean, log_std, old_log_std = gaussians()
    new, old = Normal(mean, log_std.exp()), Normal(batch.mean, old_log_std.exp())
    expected = (new.log_prob(batch.action) - old.log_prob(batch.action)).sum(-1)
    torch.testing.assert_close(ppo.log_ratio(batch, mean, log_std, old_log_std), expected)
    result = ppo.kl_divergence(batch.mean, old_log_std, mean, log_std)
    torch.testing.assert_close(result, kl_divergence(old, new).sum(-1).mean())
    torch.testing.assert_close(ppo.entropy(log_std), new.entropy()[0].sum())


def test_means_beyond_the_bound_are_pulled_back_from_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where advantages, errors of the value and the bonus are zero, nothing else is left of the gradient."""
    args = parse(ppo.Args, "--env ant --device cpu --hidden 16 --epochs 1 --entropy-coef 0".split())
    learner, seen = ppo.PPO(args, diffsim.make("ant", num_envs=1)), list[torch.Tensor]()
    monkeypatch.setattr(learner, "minibatches", 1)
    (layer,) = learner.actor_critic.mean
    excess = torch.tensor([0.5, -0.5, 0.25, -0.25])
    means = torch.cat((excess + excess.sign() * ppo.BOUND, torch.tensor([ppo.BOUND - 0.1, 0.1 - ppo.BOUND, 1.0, 0.0])))
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.copy_(means)
    obs = torch.randn(30, 37)
    mean, value = learner.actor_critic(obs)
    step, place = learner.optimizer.step, layer.bias.storage_offset()

    def recorded(gradient: torch.Tensor) -> torch.Tensor:
        seen.append(gradient[place : place + 8].clone())
        return step(gradient)

    monkeypatch.setattr(learner.optimizer, "step", recorded)
    learner.learn(ppo.Batch(obs, mean.detach(), mean.detach(), torch.zeros(30), value.detach()))
    expected = torch.cat((2 * ppo.BOUND_COEF * excess, torch.zeros(4)))  # of the squared excess
    torch.testing.assert_close(seen, [expected], rtol=1e-5, atol=1e-10)


def test_entropy_bonus_raises_the_noise(tmp_path: Path) -> None:
    """A wrong sign would lower it; the bonus is so large that nothing else counts."""
    arguments = "--env cartpole --iterations 2 --eval-episodes 4 --threads 1 --quiet --entropy-coef 100"
    checkpoint = run(ppo, tmp_path, *arguments.split())
    assert checkpoint["modules"]["actor_critic"]["log_std"].item() > 0.005


def test_clipped_objective_and_its_gradient_case_by_case() -> None:
    """Figure 1 of the PPO paper: the gain is bounded on one side, which depends on the advantage's sign."""
    cases = [  # ratio, advantage, loss, its derivative in log ratio
        (1.0, 2.0, -2.0, -2.0),
        (1.1, 2.0, -2.2, -2.2),
        (1.5, 2.0, -2.4, 0.0),
        (0.5, 2.0, -1.0, -1.0),
        (1.5, -2.0, 3.0, 3.0),
        (0.5, -2.0, 1.6, 0.0),
        (0.9, -2.0, 1.8, 1.8),
    ]
    for ratio, advantage, loss, slope in cases:
        log_ratio = torch.tensor([ratio], dtype=torch.float64).log().requires_grad_()
        result = ppo.clipped_loss(log_ratio.exp(), torch.tensor([advantage], dtype=torch.float64), 0.2)
        assert result.item() == pytest.approx(loss)
        assert torch.autograd.grad(result, log_ratio)[0].item() == pytest.approx(slope), (ratio, advantage)


@pytest.mark.parametrize(
    ("lr", "kl", "expected"),
    [(1e-3, 0.3, 1e-3 / 1.5), (1e-3, 0.19, 1e-3), (1e-3, 0.06, 1e-3), (1e-3, 0.04, 1.5e-3), (1e-3, float("nan"), 1e-3)]
    + [(1.2e-6, 0.3, 1e-6), (9e-3, 0.01, 1e-2)],
)
def test_learning_rate_follows_the_divergence(lr: float, kl: float, expected: float) -> None:
    tensor = torch.tensor(lr)
    ppo.adapt(tensor, torch.tensor(kl), 0.1, (1e-6, 1e-2))
    assert tensor.item() == pytest.approx(expected)


def test_cartpole_improves_within_seconds(tmp_path: Path) -> None:
    """From about -2,200 per episode; a wrong sign of advantage, ratio or clipping stays there or falls."""
    arguments = "--env cartpole --iterations 9 --eval-episodes 1 --threads 1 --quiet"
    run(ppo, tmp_path, *arguments.split())
    returns = [float(row["return"]) for row in read_progress(tmp_path)]
    assert returns[0] < -2000 and returns[-1] > -1700

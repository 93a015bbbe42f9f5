"""SHAC's parts against plain reference implementations, and its own switches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import SMALL, assert_derivatives, assert_same, run
from problems import lambda_returns
from torch import Tensor

import diffsim
import shac
from diffsim.training import parse

GAMMA, LAM = 0.97, 0.9


def random_rollout(rng: np.random.Generator, horizon: int = 12, num_envs: int = 50, obs_dim: int = 3) -> shac.Rollout:
    """Rewards and observations at random; a fifth of the steps ends an episode, by termination or by time-out."""
    size = (horizon, num_envs)
    kind = rng.choice(3, size=size, p=(0.8, 0.1, 0.1))
    real = [torch.tensor(rng.normal(size=s), requires_grad=True) for s in ((*size, obs_dim), (*size, obs_dim), size)]
    return shac.Rollout(*real, torch.tensor(kind == 1), torch.tensor(kind > 0))


def build(task: str, *arguments: str, dtype: torch.dtype = torch.float32) -> shac.SHAC:
    """The algorithm on three environments and rollouts of eight steps; in float64 not to be optimised."""
    args = parse(shac.Args, ["--env", task, "--horizon", "8", "--device", "cpu", *arguments])
    learner = shac.SHAC(args, diffsim.make(task, num_envs=3, seed=0, horizon=args.horizon, dtype=dtype))
    for module in (learner.actor, learner.critic, learner.target):
        module.to(dtype)
    return learner


@pytest.mark.parametrize("lam", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("horizon", [1, 12])
def test_td_lambda_is_equation_7(rng: np.random.Generator, lam: float, horizon: int) -> None:
    rollout = random_rollout(rng, horizon)
    reward, done = rollout.reward.detach().numpy(), rollout.done.numpy()
    value = rng.normal(size=reward.shape)
    expected = lambda_returns(reward, value, done, GAMMA, lam)
    result = shac.td_lambda(rollout.reward.detach(), torch.tensor(value), rollout.done, GAMMA, lam)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("horizon", [1, 12])
def test_actor_loss_and_its_gradient_are_those_of_a_loop(rng: np.random.Generator, horizon: int) -> None:
    rollout = random_rollout(rng, horizon, obs_dim=5)
    learner = build("cartpole", "--critic-hidden", "8", dtype=torch.float64)
    normalizer = learner.actor.normalizer
    normalizer.update(torch.tensor(rng.normal(1.0, 3.0, size=(100, 5))))

    loss = torch.zeros((), dtype=torch.float64)
    for i in range(rollout.reward.shape[1]):
        discount = 1.0
        for t in range(horizon):
            loss = loss - discount * rollout.reward[t, i]
            discount *= GAMMA
            if (rollout.done[t, i] or t == horizon - 1) and not rollout.terminated[t, i]:
                # The episode timed out, or the rollout ends; a terminated one has no value.
                loss = loss - discount * learner.target(normalizer(rollout.next_obs[t, i]))[0]
            if rollout.done[t, i]:
                discount = 1.0
    loss = loss / rollout.reward.numel()

    result = shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, GAMMA)
    torch.testing.assert_close(result, loss)
    inputs = rollout.reward, rollout.next_obs
    torch.testing.assert_close(torch.autograd.grad(result, inputs), torch.autograd.grad(loss, inputs))


def test_gradient_of_the_actor_loss_is_its_finite_difference() -> None:
    """The paper's Fig. 11: policy weights one at a time, of ants that run out of time, fall, and do neither."""
    torch.manual_seed(0)
    learner = build("ant", "--actor-hidden", "16", "--critic-hidden", "16", dtype=torch.float64)
    env, policy = learner.env, learner.actor
    with torch.no_grad():
        for _ in range(2):
            policy.normalizer.update(shac.collect(env, policy, policy.sample_noise(8, 3)).obs)
    env.episode_step[1] = env.episode_length - 4
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    qpos[2, 2], qvel[2, 2] = 0.4, -6.0
    env.set_state(qpos, qvel)
    start = env.state_dict()
    noise = torch.randn(8, 3, 8, dtype=torch.float64)

    def loss() -> Tensor:
        env.load_state_dict(start)
        rollout = shac.collect(env, policy, policy.log_std.exp() * noise)
        assert rollout.done.any(0).tolist() == [False, True, True]
        assert rollout.terminated.any(0).tolist() == [False, False, True]
        return shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, GAMMA)

    places = (("mean.0.weight", 40), ("mean.2.bias", 3), ("mean.3.weight", 7), ("log_std", 2))
    assert_derivatives(dict(policy.named_parameters()), loss, places, rel=5e-6)


def test_the_critic_is_fitted_to_the_returns_and_the_target_follows_slowly() -> None:
    torch.manual_seed(0)
    learner = build("cartpole", "--critic-hidden", "8", "--target-alpha", "0.9", "--critic-iterations", "1")
    obs, value = torch.randn(24, 5), torch.randn(24, 1)
    learner.critic_optimizer.lr.fill_(0.0)
    before = learner.critic_optimizer.vector.clone()
    loss = (learner.critic(obs) - value).square().mean()  # the mean of four minibatches of six samples
    torch.testing.assert_close(learner.fit_critic(obs, value), loss.detach())
    assert torch.equal(learner.critic_optimizer.vector, before)

    learner.critic_optimizer.lr.fill_(1e-2)
    old = [parameter.clone() for parameter in learner.target.parameters()]
    learner.iterate()
    assert not torch.equal(learner.critic_optimizer.vector, before)
    for o, slow, fast in zip(old, learner.target.parameters(), learner.critic.parameters(), strict=True):
        torch.testing.assert_close(slow, 0.9 * o + 0.1 * fast.detach())
        assert not slow.requires_grad
    losses = [learner.fit_critic(obs, value).item() for _ in range(200)]
    assert losses[-1] < 0.2 * losses[0]


@pytest.mark.parametrize(
    "arguments",
    [
        "--num-envs 1 --horizon 1 --critic-minibatches 1",
        "--num-envs 3 --horizon 5 --critic-minibatches 7 --initial-log-std=-inf --general-hyperparameters",
        "--num-envs 2 --implicit --substeps 2 --eval-every 2 --threads 1",
    ],
)
def test_unusual_settings_train(arguments: str, tmp_path: Path) -> None:
    words = "--env-id", "cartpole", *arguments.split(), "--iterations", 3, "--eval-episodes", 1
    checkpoint = run(shac, tmp_path, *words)
    modules = checkpoint["modules"]
    assert modules["actor_optimizer"]["skipped"] == 0
    assert all(weight.isfinite().all() for weight in modules["critic"].values())


def test_a_deterministic_policy_has_no_noise() -> None:
    learner = build("cartpole", "--initial-log-std=-inf")
    assert not learner.actor.sample_noise(4, 3).any()
    assert "log_std" not in {name for name, p in learner.actor.named_parameters() if p.requires_grad}
    assert build("cartpole").actor.sample_noise(400, 3).std().item() == pytest.approx(np.exp(-1.0), rel=0.1)


def test_without_critic_only_the_rewards_of_the_window_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loss, next_values = shac.actor_loss, []

    def recorded(reward: Tensor, next_value: Tensor, *rest: Any) -> Tensor:
        next_values.append(next_value)
        return loss(reward, next_value, *rest)

    monkeypatch.setattr(shac, "actor_loss", recorded)
    without = run(shac, tmp_path / "without", *SMALL["shac"], "--critic-iterations", 0, stop_after=2)["modules"]
    assert len(next_values) == 2 and not any(value.any() for value in next_values)
    assert not without["critic_optimizer"]["adam"][0]["step"]
    assert_same(without["critic"], without["target"])
    run(shac, tmp_path / "with", *SMALL["shac"], stop_after=1)
    assert next_values[2].any()

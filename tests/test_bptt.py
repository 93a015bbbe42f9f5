"""BPTT's loss and gradient against plain reference implementations, and its own switches."""

from __future__ import annotations

import pytest
import torch
from learners import assert_derivatives, read_progress, run

import bptt
import diffsim
from diffsim.training import parse


def build(task: str, *arguments: str, dtype: torch.dtype = torch.float32) -> bptt.BPTT:
    """The algorithm on three environments; in float64 not to be optimised."""
    args = parse(bptt.Args, ["--env", task, "--device", "cpu", *arguments])
    learner = bptt.BPTT(args, diffsim.make(task, num_envs=3, seed=0, horizon=args.horizon, dtype=dtype))
    learner.actor.to(dtype)
    return learner


@pytest.mark.parametrize("horizon", [1, 12])
def test_loss_and_its_gradient_are_those_of_a_loop(rng, horizon):
    """Eq. 8 without a value, each environment on its own; a fifth of the steps ends an episode."""
    gamma = 0.97
    reward = torch.tensor(rng.normal(size=(horizon, 50)), requires_grad=True)
    done = torch.tensor(rng.random((horizon, 50)) < 0.2)
    loss = torch.zeros((), dtype=torch.float64)
    for i in range(50):
        discount = 1.0
        for t in range(horizon):
            loss = loss - discount * reward[t, i] / (50 * horizon)
            discount = 1.0 if done[t, i] else discount * gamma
    result = bptt.bptt_loss(reward, done, gamma)
    torch.testing.assert_close(result, loss)
    torch.testing.assert_close(torch.autograd.grad(result, reward), torch.autograd.grad(loss, reward))


def test_gradient_is_the_finite_difference():
    """Through a whole rollout of three ants of which one runs out of time."""
    torch.manual_seed(0)
    learner = build("ant", "--hidden", "16", "--horizon", "8", dtype=torch.float64)
    env, policy = learner.env, learner.actor
    env.episode_step[1] = env.episode_length - 4
    start = env.state_dict()
    noise = torch.randn(8, 3, env.single_action_space.shape[0], dtype=torch.float64)

    def loss() -> torch.Tensor:
        env.load_state_dict(start)
        rollout = bptt.collect(env, policy, policy.log_std.exp() * noise)
        assert rollout.done.any(0).tolist() == [False, True, False] and rollout.done[3, 1]
        return bptt.bptt_loss(rollout.reward, rollout.done, 0.99)

    places = (("mean.0.weight", 40), ("mean.3.weight", 7), ("log_std", 0))
    assert_derivatives(dict(policy.named_parameters()), loss, places, rel=1e-5)


def test_large_gradients_are_followed():
    """An exploding gradient is what this baseline is about. An infinite one is skipped."""
    optimizer = build("cartpole").optimizer
    before, weights = optimizer.vector.clone(), optimizer.parameters
    optimizer.lr.fill_(1e-2)
    assert optimizer.step(optimizer.gradient(1e15 * sum(weight.square().sum() for weight in weights))) > 1e15
    assert optimizer.skipped == 0 and not torch.equal(optimizer.vector, before)
    before.copy_(optimizer.vector)
    optimizer.step(optimizer.gradient(torch.inf * sum(weight.square().sum() for weight in weights)))
    assert optimizer.skipped == 1 and torch.equal(optimizer.vector, before)
    assert optimizer.max_norm == 1.0 and optimizer.betas == (0.7, 0.95)


@pytest.mark.parametrize("flag", ["--normalize-obs", "--no-normalize-obs"])
def test_observations_are_normalized_on_request(flag, tmp_path):
    arguments = f"--env cartpole --num-envs 2 --horizon 8 --iterations 2 {flag} --eval-episodes 1 --quiet"
    policy = run(bptt, tmp_path, *arguments.split())["modules"]["actor"]
    assert policy["normalizer.count"] == (2 * 8 * 2 if flag == "--normalize-obs" else 0)


def test_a_window_as_long_as_the_episode_swings_the_pole_up_in_part(tmp_path):
    """From -2,375 per episode of 240 steps to -1,890; a wrong sign only gets worse."""
    arguments = "--env cartpole --num-envs 16 --horizon 240 --iterations 8 --eval-episodes 1 --quiet"
    run(bptt, tmp_path, *arguments.split())
    rows = read_progress(tmp_path)
    assert rows[0]["length"] == "240.0"  # every rollout holds a whole episode
    assert float(rows[0]["return"]) < -2200 and float(rows[-1]["return"]) > -2000

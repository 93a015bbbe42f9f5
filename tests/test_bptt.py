"""BPTT's loss and gradient against plain reference implementations."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from learners import assert_derivatives, run

import bptt
import diffsim


@pytest.mark.parametrize("horizon", [1, 12])
def test_loss_and_its_gradient_are_those_of_a_loop(rng: np.random.Generator, horizon: int) -> None:
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


@pytest.mark.parametrize(("task", "horizon"), [("cartpole", 64), ("ant", 8)])
def test_gradient_is_the_finite_difference(task: str, horizon: int) -> None:
    """Through a whole window of cartpole, and of ants of which one runs out of time."""
    torch.manual_seed(0)
    env = diffsim.make(task, num_envs=3, seed=0, horizon=horizon, dtype=torch.float64)
    actor, normalise = (part.double() for part in bptt.build(bptt.Args(hidden=(16,)), env))
    env.episode_step[1] = env.episode_length - 4
    start = env.state_dict()
    noise = torch.randn(horizon, 3, env.single_action_space.shape[0], dtype=torch.float64)

    def loss() -> torch.Tensor:
        env.load_state_dict(start)
        window = bptt.collect(env, actor, normalise, actor.log_std.exp() * noise)
        assert window.truncated.any(0).tolist() == [False, True, False] and not window.terminated.any()
        return bptt.bptt_loss(window.reward, window.done, 0.99)

    places = (("mean.0.weight", 40), ("mean.3.weight", 7), ("log_std", 0))
    assert_derivatives(dict(actor.named_parameters()), loss, places, rel=1e-5)


def test_large_gradients_are_clipped_and_only_infinite_ones_skipped() -> None:
    """An exploding gradient is what this baseline is about: it is followed as long as it has a direction."""
    torch.manual_seed(0)
    module = bptt.mlp(3, (5,), 1, orthogonal=False)
    optimizer = bptt.ClippedAdam(module, bptt.Args())
    optimizer.lr.fill_(1e-2)
    reference = torch.nn.Parameter(optimizer.vector.clone())
    adam = torch.optim.Adam([reference], 1e-2, betas=(0.7, 0.95))
    inputs = torch.randn(20, 3)
    for scale in (1.0, 1e12, float("nan"), float("inf"), 1e3):
        loss = scale * module(inputs).square().mean()
        gradients = torch.autograd.grad(loss, optimizer.parameters, retain_graph=True)
        gradient = torch.cat([g.flatten() for g in gradients])
        norm = optimizer.step(loss)
        if scale < float("inf"):
            torch.testing.assert_close(norm, gradient.norm())
            reference.grad = gradient / norm.clamp(min=1.0)
            adam.step()
        torch.testing.assert_close(optimizer.vector, reference.detach())
    assert optimizer.skipped == 2


@pytest.mark.parametrize("normalised", [True, False])
def test_observations_are_normalised_on_request(normalised: bool, tmp_path: Path) -> None:
    arguments = f"--env cartpole --num-envs 2 --horizon 8 --iterations 2 --normalise-obs {normalised} --eval-episodes 1"
    checkpoint = run(bptt, tmp_path, *arguments.split(), "--quiet")
    assert checkpoint["normalise"]["count"] == (2 * 8 * 2 if normalised else 0)


def test_a_window_as_long_as_the_episode_swings_the_pole_up_in_part(tmp_path: Path) -> None:
    """From -2,375 per episode of 240 steps to -1,550; a wrong sign only gets worse."""
    arguments = "--env cartpole --num-envs 16 --horizon 240 --iterations 15 --eval-episodes 16 --quiet"
    run(bptt, tmp_path, *arguments.split())
    with (tmp_path / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["length"] == "240.0"  # every window holds a whole episode
    assert float(rows[0]["return"]) < -2200 and float(rows[-1]["return"]) > -1800

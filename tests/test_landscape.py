"""The benchmark of loss landscapes: many variations of a policy in one batch are what each one is alone."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import landscape
import numpy as np
import pytest
import torch

import diffsim
import shac


@pytest.fixture
def snapshot() -> landscape.Snapshot:
    torch.manual_seed(0)
    settings = shac.Args(device="cpu", actor_hidden=(16,), critic_hidden=(16,))
    env = diffsim.make("ant", num_envs=3, seed=0)
    actor, normalise = shac.build(settings, env)
    normalise.update(torch.randn(100, 37) + 1.0)
    return landscape.Snapshot(settings, actor, normalise, shac.mlp(37, (16,), 1, orthogonal=True).requires_grad_(False))


def test_losses_and_gradients_of_variations(snapshot: landscape.Snapshot, tmp_path: Path) -> None:
    args = landscape.Args(env=("ant",), device="cpu", trajectories=3, warmup=2, batch=6, runs=tmp_path, docs=tmp_path)
    _, start = landscape.start_states(args, "ant", snapshot)
    directions, horizon = landscape.random_directions(args, snapshot), 8
    assert all(
        d.flatten(1).norm(dim=1).tolist() == pytest.approx([0.5 * w.norm().item()] * 2, rel=1e-4)
        for d, w in zip(directions.values(), snapshot.actor.parameters(), strict=True)
    )
    steps = torch.tensor([[0.0, 0.0], [0.1, -0.2], [0.4, 0.3]])
    common = args, "ant", snapshot, landscape.shac_loss, start, horizon, directions
    losses, gradients = landscape.evaluate(*common, steps, gradient=True)

    env = diffsim.make("ant", num_envs=3, horizon=horizon)  # the same, one after another, as shac.py does it
    weights = {name: tensor.detach().clone() for name, tensor in snapshot.actor.named_parameters()}
    for k, step in enumerate(steps):
        for name, parameter in snapshot.actor.named_parameters():
            parameter.data = weights[name] + torch.einsum("k,k...->...", step, directions[name])
        env.set_state(*start)
        torch.manual_seed(0)
        window = shac.collect(env, snapshot.actor, snapshot.normalise, snapshot.actor.sample_noise(horizon, 3))
        next_value = shac.next_values(snapshot.target, snapshot.normalise, window)
        expected = shac.actor_loss(window.reward, next_value, window.done, 0.99)
        assert losses[k] == pytest.approx(expected.item(), rel=1e-5)
        slopes = torch.autograd.grad(expected, list(snapshot.actor.parameters()))
        dot = sum(torch.einsum("k...,...->k", d, g) for d, g in zip(directions.values(), slopes, strict=True))
        np.testing.assert_allclose(gradients[k], dot, rtol=1e-3, atol=1e-5)
        whole, _ = landscape.evaluate(*common[:3], landscape.bptt_loss, *common[4:], torch.zeros(1, 2))
        assert whole[0] == pytest.approx(-window.reward.mean().item(), rel=1e-5)


def test_rewards_after_the_end_of_an_episode_do_not_count(
    snapshot: landscape.Snapshot, monkeypatch: pytest.MonkeyPatch
) -> None:
    reward = torch.arange(1.0, 9.0).reshape(4, 1, 2)
    terminated, truncated = torch.zeros(4, 1, 2, dtype=torch.bool), torch.zeros(4, 1, 2, dtype=torch.bool)
    terminated[1, 0, 0] = truncated[0, 0, 1] = terminated[3, 0, 1] = True
    monkeypatch.setattr(landscape, "rollout", lambda *_: (reward, terminated, truncated, None))
    assert landscape.bptt_loss(None, snapshot, {}, None, 4).tolist() == [-(1 + 3 + 2) / 8]


def test_the_command_trains_measures_and_draws(tmp_path: Path) -> None:
    look = "--env cartpole --iterations 2 4 --trajectories 2 --points 5 --side 3 --horizon 40 --device cpu".split()
    command = [sys.executable, landscape.__file__, *look, "--runs", str(tmp_path / "runs"), "--docs", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    for name, count in (("gradients", 2), ("weight", 5), ("surface", 9)):
        rows = list(csv.DictReader((tmp_path / "results" / f"landscape_cartpole_{name}.csv").open()))
        assert len(rows) == count
        assert (tmp_path / f"landscape_cartpole_{name}.png").stat().st_size > 5_000
    assert "landscape_cartpole_surface.png" in (tmp_path / "experiments.md").read_text()

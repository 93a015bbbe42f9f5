"""The benchmark of loss landscapes: many variations of a policy in one batch are what each one is alone."""

from __future__ import annotations

from pathlib import Path

import landscape
import numpy as np
import pytest
import torch
from common import parse
from tables import read_csv

import diffsim
import shac


@pytest.fixture
def look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> landscape.Look:
    monkeypatch.setattr(landscape, "WARMUP", 2)
    torch.manual_seed(0)
    args = landscape.Args(("ant",), "cpu", trajectories=3, batch=6, horizon=8, runs=tmp_path)
    settings = shac.Args(device="cpu", actor_hidden=(16,), critic_hidden=(16,), horizon=8)
    learner = shac.SHAC(settings, diffsim.make("ant", num_envs=3, seed=0))
    learner.actor.normalizer.update(torch.randn(100, 37) + 1.0)
    return landscape.Look(args, "ant", learner)


def test_losses_and_gradients_of_variations(look: landscape.Look) -> None:
    directions, policy = look.random_directions(), look.policy
    assert all(
        d.flatten(1).norm(dim=1).tolist() == pytest.approx([0.5 * w.norm().item()] * 2, rel=1e-4)
        for d, w in zip(directions.values(), policy.parameters(), strict=True)
    )
    steps = torch.tensor([[0.0, 0.0], [0.1, -0.2], [0.4, 0.3]])
    losses, slopes = look.vary("shac", directions, steps, slope=True)
    look.starts["bptt"] = look.starts["shac"]

    env = diffsim.make("ant", num_envs=3, horizon=8)  # the same, one after another, as shac.py does it
    learner = shac.SHAC(shac.Args(device="cpu", actor_hidden=(16,), critic_hidden=(16,), horizon=8), env)
    learner.actor, learner.target = policy, look.target
    weights = {name: tensor.detach().clone() for name, tensor in policy.named_parameters()}
    for k, step in enumerate(steps):
        for name, parameter in policy.named_parameters():
            parameter.data = weights[name] + torch.einsum("k,k...->...", step, directions[name])
        env.set_state(*look.starts["shac"])
        torch.manual_seed(0)
        rollout = shac.collect(env, policy, policy.sample_noise(8, 3))
        expected = shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, 0.99)
        assert losses[k] == pytest.approx(expected.item(), rel=1e-5)
        gradient = torch.autograd.grad(expected, list(policy.parameters()))
        dot = sum(torch.einsum("k...,...->k", d, g) for d, g in zip(directions.values(), gradient, strict=True))
        np.testing.assert_allclose(slopes[k], dot, rtol=1e-3, atol=1e-5)
        look.weights = {name: tensor.detach() for name, tensor in policy.named_parameters()}
        whole, _ = look.vary("bptt", directions, torch.zeros(1, 2))
        assert whole[0] == pytest.approx(-rollout.reward.mean().item(), rel=1e-5)


def test_rewards_after_the_end_of_an_episode_do_not_count(
    look: landscape.Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    reward = torch.arange(1.0, 9.0).reshape(4, 1, 2)
    terminated, truncated = torch.zeros(4, 1, 2, dtype=torch.bool), torch.zeros(4, 1, 2, dtype=torch.bool)
    terminated[1, 0, 0] = truncated[0, 0, 1] = terminated[3, 0, 1] = True
    monkeypatch.setattr(look, "rollout", lambda *_: (reward, terminated, truncated, None))
    assert look.losses("bptt", look.make_env(1, 1), {}).tolist() == [-(1 + 3 + 2) / 8]


def test_the_command_trains_measures_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(landscape, "WARMUP", 2)
    flags = "--env cartpole --iterations 2 --trajectories 1 --points 5 --side 4 --horizon 40 --device cpu".split()
    places = ["--runs", str(tmp_path / "runs"), "--output", str(tmp_path)]
    landscape.main(parse(landscape.Args, None, [*flags, *places]))
    for name, count in (("gradients", 1), ("weight", 5), ("surface", 16)):
        assert len(read_csv(tmp_path / f"landscape_cartpole_{name}.csv")) == count
        assert (tmp_path / f"landscape_cartpole_{name}.png").stat().st_size > 5_000
    assert "landscape_cartpole_surface.png" in capsys.readouterr().out

"""The benchmark of loss landscapes: its losses are those of shac.py and bptt.py."""

from __future__ import annotations

from pathlib import Path

import landscape
import pytest
import torch
from tables import read_csv

import diffsim
import shac


@pytest.fixture
def look(monkeypatch: pytest.MonkeyPatch) -> landscape.Look:
    monkeypatch.setattr(landscape, "WARMUP", 2)
    torch.manual_seed(0)
    settings = shac.Args(env="ant", device="cpu", actor_hidden=(16,), critic_hidden=(16,), horizon=8)
    learner = shac.SHAC(settings, diffsim.make("ant", num_envs=3, seed=0))
    learner.actor.normalizer.update(torch.randn(100, 37) + 1.0)
    return landscape.Look(landscape.Args(trajectories=3, horizon=8), learner)


def test_losses_along_the_steepest_weight(look: landscape.Look) -> None:
    """In its middle the loss of the policy itself, whose weight is as before; the slope is that of differences."""
    weights = list(look.actor.parameters())
    before, alone = [w.detach().clone() for w in weights], [look.loss("bptt").item(), look.loss("shac").item()]
    largest = max(g.abs().max().item() for g in torch.autograd.grad(look.loss("shac"), weights) if g.ndim == 2)
    rows = [{name: float(str(x)) for name, x in row.items()} for row in look.along_a_weight(41)]
    assert all(torch.equal(w, old) for w, old in zip(weights, before, strict=True))
    middle, after = rows[20], rows[21]
    assert [middle["bptt"], middle["shac"]] == pytest.approx(alone, rel=1e-5)
    assert (after["shac"] - rows[19]["shac"]) / 0.1 == pytest.approx(middle["shac_gradient"], rel=5e-2)
    assert abs(middle["shac_gradient"]) == pytest.approx(largest, rel=1e-4)
    assert middle["bptt"] != middle["shac"]  # from other states, and without a value


def test_rewards_after_the_end_of_an_episode_do_not_count(
    look: landscape.Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    reward, done = torch.arange(1.0, 9.0).reshape(4, 2), torch.zeros(4, 2, dtype=torch.bool)
    done[1, 0] = done[0, 1] = done[3, 1] = True
    monkeypatch.setattr(shac, "collect", lambda *_: shac.Rollout(reward, reward, reward, done, done))
    assert look.loss("bptt").item() == -(1 + 3 + 2) / 8


def test_the_command(tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landscape, "WARMUP", 2)
    args = landscape.Args(checkpoints=(tiny_run,), trajectories=1, points=5, horizon=40, output=tmp_path)
    landscape.main(args)
    assert len(read_csv(tmp_path / "landscape_cartpole.csv")) == 5
    assert (tmp_path / "landscape_cartpole.png").stat().st_size > 5_000

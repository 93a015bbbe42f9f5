"""The benchmark of loss landscapes: its losses are those of shac.py and bptt.py."""

from __future__ import annotations

from pathlib import Path

import landscape
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
    args = landscape.Args(("ant",), "cpu", trajectories=3, horizon=8, runs=tmp_path)
    settings = shac.Args(device="cpu", actor_hidden=(16,), critic_hidden=(16,), horizon=8)
    learner = shac.SHAC(settings, diffsim.make("ant", num_envs=3, seed=0))
    learner.actor.normalizer.update(torch.randn(100, 37) + 1.0)
    return landscape.Look(args, "ant", learner)


def test_losses_along_the_steepest_weight(look: landscape.Look) -> None:
    """In its middle the loss of the policy itself, whose weight is as before; the slope is that of differences."""
    with torch.no_grad():
        before, alone = [w.clone() for w in look.actor.parameters()], {n: look.loss(n).item() for n in landscape.LOSSES}
    rows = [{name: float(str(x)) for name, x in row.items()} for row in landscape.along_a_weight(look, 401)]
    assert all(torch.equal(w, old) for w, old in zip(look.actor.parameters(), before, strict=True))
    middle, after = rows[200], rows[201]
    assert (middle["bptt"], middle["shac"]) == pytest.approx([*alone.values()], rel=1e-5)
    assert (after["shac"] - rows[199]["shac"]) / 1e-2 == pytest.approx(middle["shac_gradient"], rel=2e-2)
    largest = max(g.abs().max().item() for g in look.gradient("shac") if g.ndim == 2)
    assert abs(middle["shac_gradient"]) == pytest.approx(largest, rel=1e-4)
    assert middle["bptt"] != middle["shac"]  # from other states, and without a value


def test_rewards_after_the_end_of_an_episode_do_not_count(
    look: landscape.Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    reward, done = torch.arange(1.0, 9.0).reshape(4, 2), torch.zeros(4, 2, dtype=torch.bool)
    done[1, 0] = done[0, 1] = done[3, 1] = True
    monkeypatch.setattr(shac, "collect", lambda *_: shac.Rollout(reward, reward, reward, done, done))
    assert look.loss("bptt").item() == -(1 + 3 + 2) / 8


def test_the_command_trains_measures_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landscape, "WARMUP", 2)
    flags = "--env cartpole --iterations 2 --trajectories 1 --points 5 --horizon 40 --device cpu".split()
    places = ["--runs", str(tmp_path / "runs"), "--output", str(tmp_path)]
    landscape.main(parse(landscape.Args, None, [*flags, *places]))
    for name, count in (("gradients", 1), ("weight", 5)):
        assert len(read_csv(tmp_path / f"landscape_cartpole_{name}.csv")) == count
        assert (tmp_path / f"landscape_cartpole_{name}.png").stat().st_size > 5_000

"""Factors of the constants over a training, and the flags that ask for them."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import assert_same, refusal, run

import diffsim
import shac
from diffsim.robot.scene import FACTORS
from diffsim.tasks import TASKS
from diffsim.training import parse
from diffsim.training.variation import Variation, parse_ranges


@pytest.fixture(scope="module")
def env() -> diffsim.DiffEnv:
    return diffsim.make("hopper", 2000, contact="mujoco", factors=True)


def column(env: diffsim.DiffEnv, name: str) -> torch.Tensor:
    return env.sim.factors[:, FACTORS.index(name)]


def test_factors_are_drawn_for_each_environment_and_constant(env: diffsim.DiffEnv) -> None:
    """Uniform in the logarithm, and drawn anew when it is time."""
    ranges = {"friction": (0.5, 2.0), "mass": (0.9, 1.2), "stiffness": (1.0, 4.0)}
    variation = Variation(env, ranges, 10, 1)
    variation.set(100)
    drawn = env.sim.factors.log()
    for name, (least, most) in (("mu", (0.5, 2.0)), ("mass", (0.9, 1.2)), ("k_n", (1.0, 4.0)), ("d_limit", (1.0, 4.0))):
        logs, low, high = drawn[:, FACTORS.index(name)], math.log(least), math.log(most)
        assert low <= logs.min() < low + 0.02 and high - 0.02 < logs.max() <= high
        assert logs.mean() == pytest.approx((low + high) / 2, abs=0.05)
    assert (column(env, "motor") == 1).all()
    assert torch.corrcoef(drawn[:, [0, 1, 3]].T)[0, 1:].abs().max() < 0.1  # each constant by itself
    variation.set(101)
    first = env.sim.factors.clone()
    assert not torch.equal(first, drawn.exp())
    variation.set(110)
    assert torch.equal(first, env.sim.factors)
    variation.set(111)
    assert not torch.equal(first, env.sim.factors)
    Variation(env, ranges, 10, 1).set(105)  # of the iteration alone
    assert torch.equal(first, env.sim.factors)
    Variation(env, ranges, 10, 2).set(105)
    assert not torch.equal(first, env.sim.factors)


def test_what_divides_the_gradient_is_positive(env: diffsim.DiffEnv) -> None:
    factors = torch.ones_like(env.sim.factors)
    factors[3, FACTORS.index("mu")] = 0.0
    env.sim.factors = factors
    for name in ("k_n", "k_d", "k_limit"):
        bad = factors.clone()
        bad[5, FACTORS.index(name)] = 0.0
        with pytest.raises(ValueError, match=rf"factors\[5, {FACTORS.index(name)}\] is 0.0; .* positive"):
            env.sim.factors = bad


@pytest.mark.parametrize(
    "items, message",
    [
        ("friction", "'friction' is not a range like friction=0.7:1.3"),
        ("friction=1", "'friction=1' is not a range"),
        ("friction=a:b", "'friction=a:b' is not a range"),
        ("mu=0.5:1", "unknown 'mu': choose from friction, stiffness, mass, motor"),
        ("mass=0:1", "factors must be positive and finite, the smaller one first"),
        ("mass=2:1", "the smaller one first"),
        ("mass=1:inf", "positive and finite"),
        ("mass=nan:2", "positive and finite"),
    ],
)
def test_wrong_ranges_are_refused(items: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        parse_ranges([items])
    assert message in refusal(lambda: shac.main(["--env", "hopper", "--randomise", items]), capsys)


def test_disturbances_are_the_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    """Drawn in each episode; only joystick tasks have some."""
    asked = ["latency=0.5:1", "push=0:0.5", "mass=0.9:1.1"]
    ranges = parse_ranges(asked, TASKS["go2"])
    env = diffsim.make("go2", 300, factors=True)
    Variation(env, ranges, 10, 1).set(1)
    late = env.memory[:, -6]
    assert 0.5 <= late.min() < 0.6 and 0.9 < late.max() <= 1 and env.task.disturbances["push"] == (0.0, 0.5)
    assert column(env, "mass").std() > 0.01 and (column(env, "motor") == 1).all()
    for item, message in (
        ("latency=0:3", "'latency=0:3': must be from 0 to 2, the smaller one first"),
        ("push=1:0.5", "'push=1:0.5': must be from 0 to inf, the smaller one first"),
        ("push=0:inf", "must be from 0 to inf"),
        ("mu=1:2", "choose from friction, stiffness, mass, motor, latency, push, pull"),
    ):
        assert message in refusal(lambda item=item: shac.main(["--env", "go2", "--randomise", item]), capsys)
    assert "unknown 'push'" in refusal(lambda: shac.main(["--env", "ant", "--randomise", "push=0:1"]), capsys)


def test_runs_that_vary_resume_bitwise_and_are_evaluated_on_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect, seen = shac.collect, list[torch.Tensor]()

    def watched(env: diffsim.DiffEnv, *rest: Any) -> shac.Rollout:
        seen.append(env.sim.factors.clone())
        return collect(env, *rest)

    monkeypatch.setattr(shac, "collect", watched)
    flags = "--env hopper --contact mujoco --num-envs 16 --horizon 8 --iterations 4 --eval-episodes 2"
    flags += " --redraw 1 --randomise mass=0.9:1.1 friction=0.5:2 --device cpu --critic-iterations 2"
    flags += " --threads 1 --quiet"
    whole = run(shac, tmp_path / "whole", *flags.split())
    assert len(seen) == 4 and not any(torch.equal(a, b) for a, b in pairwise(seen))
    assert all((factors[:, FACTORS.index("mass")] != 1).all() for factors in seen)
    run(shac, tmp_path / "part", *flags.split(), "--stop-after", 2)
    part = run(shac, tmp_path / "part", "--resume", tmp_path / "part" / "checkpoint.pt", "--stop-after", 0, "--quiet")
    assert_same(part["modules"], whole["modules"])
    assert whole["args"]["integrator"] == "mujoco"
    saved = str(tmp_path / "part" / "checkpoint.pt")
    assert parse(shac.Args, ["--evaluate", saved, "--accuracy", "accurate"]).substeps == 16

"""Factors of the constants over a training, and the flags that ask for them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from learners import assert_same, refusal, run

import diffsim
import ppo_baseline
import shac
from diffsim.robot.scene import FACTORS
from diffsim.training import parse
from diffsim.training.variation import SOFT, Range, Variation, parse_ranges


@pytest.fixture(scope="module")
def env() -> diffsim.DiffEnv:
    return diffsim.make("hopper", 2000, contact="mujoco", factors=True)


def column(env: diffsim.DiffEnv, name: str) -> torch.Tensor:
    return env.sim.factors[:, FACTORS.index(name)]


def test_contact_hardens_to_the_files(env: diffsim.DiffEnv) -> None:
    variation = Variation(env, SOFT, {}, (100.0, 300.0), 10, 1)
    for iteration, share in ((1, 0.0), (100, 0.0), (150, 0.25), (300, 1.0), (400, 1.0)):
        variation.set(iteration)
        for name in FACTORS:
            expected = SOFT.get(name, 1.0) ** (1 - share)
            torch.testing.assert_close(column(env, name), torch.full((2000,), expected), msg=f"{name} {share}")


def test_factors_are_drawn_for_each_environment_and_constant(env: diffsim.DiffEnv) -> None:
    """Uniform in the logarithm, within ranges that open with the progress, and drawn anew when it is time."""
    ranges = {"friction": Range(0.5, 2.0), "mass": Range(0.9, 1.2), "stiffness": Range(1.0, 4.0)}
    variation = Variation(env, {}, ranges, (0.0, 100.0), 10, 1)
    variation.set(50)
    half = env.sim.factors.log()
    variation.set(100)
    assert not torch.allclose(env.sim.factors.log(), 2 * half)  # iterations 41 to 50, and 91 to 100
    whole = env.sim.factors.log()
    for name, (least, most) in (("mu", (0.5, 2.0)), ("mass", (0.9, 1.2)), ("k_n", (1.0, 4.0)), ("d_limit", (1.0, 4.0))):
        for progress, logs in ((0.5, half), (1.0, whole)):
            drawn, low, high = logs[:, FACTORS.index(name)] / progress, math.log(least), math.log(most)
            assert low <= drawn.min() < low + 0.02 and high - 0.02 < drawn.max() <= high
            assert drawn.mean() == pytest.approx((low + high) / 2, abs=0.05)
    assert (column(env, "motor") == 1).all()
    assert torch.corrcoef(whole[:, [0, 1, 3]].T)[0, 1:].abs().max() < 0.1  # each constant by itself
    variation.set(101)
    first = env.sim.factors.clone()
    assert not torch.equal(first, whole.exp())
    variation.set(110)
    assert torch.equal(first, env.sim.factors)
    variation.set(111)
    assert not torch.equal(first, env.sim.factors)
    Variation(env, {}, ranges, (0.0, 100.0), 10, 1).set(105)  # of the iteration alone
    assert torch.equal(first, env.sim.factors)
    Variation(env, {}, ranges, (0.0, 100.0), 10, 2).set(105)
    assert not torch.equal(first, env.sim.factors)


@pytest.mark.parametrize(
    "items, message",
    [
        ("friction", "'friction' is no range of factors like friction=0.7:1.3"),
        ("friction=1", "'friction=1' is no range"),
        ("friction=a:b", "'friction=a:b' is no range"),
        ("mu=0.5:1", "unknown 'mu': choose from friction, stiffness, mass, motor"),
        ("mass=0:1", "factors must be positive and finite, the least one first"),
        ("mass=2:1", "the least one first"),
        ("mass=1:inf", "positive and finite"),
        ("mass=nan:2", "positive and finite"),
    ],
)
def test_wrong_ranges_are_refused(items: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        parse_ranges([items])
    assert message in refusal(lambda: shac.main(["--env", "hopper", "--randomise", items]), capsys)


def test_the_span_must_be_the_right_way_round(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: shac.main("--env ant --anneal 0.5 0.2".split()), capsys)
    assert "--anneal 0.5 0.2 are the wrong way round" in error


def test_hardening_needs_the_contact_that_hardens(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: shac.main("--env ant --anneal 0.2 0.5".split()), capsys)
    assert "--anneal hardens the contact of --contact mujoco; with soft leave it at 0 0" in error


def test_runs_whose_contact_hardens_resume_bitwise_and_are_evaluated_on_the_files(tmp_path: Path) -> None:
    flags = "--env hopper --contact mujoco --num-envs 16 --horizon 8 --iterations 4 --redraw 1 --eval-episodes 2"
    flags += " --anneal 0 1 --randomise mass=0.9:1.1 --device cpu --critic-iterations 2 --threads 1 --quiet"
    whole = run(shac, tmp_path / "whole", *flags.split())
    run(shac, tmp_path / "part", *flags.split(), "--stop-after", 2)
    part = run(shac, tmp_path / "part", "--resume", tmp_path / "part" / "checkpoint.pt", "--stop-after", 0, "--quiet")
    assert_same(part["modules"], whole["modules"])
    assert whole["args"]["anneal"] == (0.0, 1.0) and whole["args"]["integrator"] == "mujoco"
    hard = run(shac, tmp_path / "hard", *flags.replace("--anneal 0 1", "--anneal 0 0").split())
    assert any(
        not torch.equal(hard["modules"]["actor"][name], value) for name, value in whole["modules"]["actor"].items()
    )
    saved = str(tmp_path / "part" / "checkpoint.pt")
    assert parse(shac.Args, ["--evaluate", saved, "--accuracy", "accurate"]).substeps == 16


def test_learners_without_gradient_vary_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    original = Variation.set

    def watch(self: Variation, iteration: int) -> None:
        original(self, iteration)
        seen.append(self.factors.clone())

    monkeypatch.setattr(Variation, "set", watch)
    flags = "--env hopper --randomise mass=0.5:2 --num-envs 16 --horizon 8 --iterations 2 --redraw 1 --quiet --epochs 1"
    flags += " --integrator implicit"  # whose kernels with factors other tests compile
    run(ppo_baseline, tmp_path, *flags.split(), "--device", "cpu", "--minibatch-size", "64", "--eval-episodes", "2")
    assert len(seen) == 2 and not torch.equal(*seen)
    mass = FACTORS.index("mass")
    assert all((factors[:, mass] != 1).all() and (factors[:, :mass] == 1).all() for factors in seen)

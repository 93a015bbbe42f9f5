"""Factors of the constants over a training, and the flags that ask for them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from learners import assert_same, refusal, run
from scenes import ROBOTS

import diffsim
import ppo_baseline
import shac
from diffsim import TASKS
from diffsim.robot.scene import FACTORS
from diffsim.training import parse
from diffsim.training.flags import RANDOMISED
from diffsim.training.variation import Range, Variation, parse_ranges, soft_factors

FIRM = sorted(name for name in ROBOTS if hasattr(TASKS[name], "firm"))


@pytest.fixture(scope="module")
def env() -> diffsim.DiffEnv:
    return diffsim.make("hopper", 2000, contact="firm", factors=True)


def column(env: diffsim.DiffEnv, name: str) -> torch.Tensor:
    return env.sim.factors[:, FACTORS.index(name)]


def test_contact_goes_from_the_files_to_the_firm_one(env: diffsim.DiffEnv) -> None:
    soft = diffsim.make("hopper", 1).scene
    variation = Variation(env, soft_factors(env.scene), {}, (100.0, 300.0), 10, 1)
    for iteration, share in ((1, 0.0), (100, 0.0), (150, 0.25), (300, 1.0), (400, 1.0)):
        variation.set(iteration)
        for name in ("k_n", "k_d", "k_t"):
            begin, end = getattr(soft, name), getattr(env.scene, name)
            expected = begin ** (1 - share) * end**share
            torch.testing.assert_close(end * column(env, name), torch.full((2000,), expected), msg=f"{name} {share}")
        torch.testing.assert_close(column(env, "d_limit"), torch.full((2000,), share))  # the file's is 0
        for name in ("mu", "mass", "motor"):
            assert (column(env, name) == 1).all()


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


@pytest.mark.parametrize("flags", ["--env cartpole --contact firm", "--env swimmer --contact firm"])
def test_tasks_without_contact_have_no_firm_one(flags: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "has no firm contact; choose soft" in refusal(lambda: shac.main(flags.split()), capsys)


def test_the_span_must_be_the_right_way_round(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: shac.main("--env ant --anneal 0.5 0.2".split()), capsys)
    assert "--anneal 0.5 0.2 are the wrong way round" in error


def test_contact_decides_constants_and_integration() -> None:
    with pytest.raises(ValueError, match="unknown contact 'hard'; choose from soft, firm"):
        diffsim.make("hopper", 1, contact="hard")  # type: ignore[arg-type]
    for name in FIRM:
        task = TASKS[name]
        firm, soft = (diffsim.make(name, 1, contact=contact) for contact in ("firm", "soft"))
        assert firm.sim.integration == task.firm.integration and soft.sim.integration == task.integration("default")
        assert {key: getattr(firm.scene, key) for key in ("k_n", "k_d", "k_t")}.items() <= task.firm.penalty.items()
        assert firm.scene.mu == soft.scene.mu and firm.scene.k_limit.max() == task.firm.k_limit
        assert firm.scene.k_n > soft.scene.k_n
    other = diffsim.make("ant", 1, contact="firm", penalty={"k_n": 7.0})
    assert other.scene.k_n == 7.0 and other.scene.k_d == TASKS["ant"].firm.k_d
    assert TASKS["ant"].integration("accurate", "firm").substeps == 4 * TASKS["ant"].firm.integration.substeps


def test_firm_runs_resume_bitwise_and_are_evaluated_on_firm_ground(tmp_path: Path) -> None:
    flags = "--env hopper --contact firm --num-envs 16 --horizon 8 --iterations 4 --redraw 1 --eval-episodes 2 --quiet"
    flags += " --device cpu --critic-iterations 2 --threads 1"
    whole = run(shac, tmp_path / "whole", *flags.split())
    run(shac, tmp_path / "part", *flags.split(), "--stop-after", 2)
    part = run(shac, tmp_path / "part", "--resume", tmp_path / "part" / "checkpoint.pt", "--stop-after", 0, "--quiet")
    assert_same(part["modules"], whole["modules"])
    assert whole["args"]["randomise"] == RANDOMISED and whole["args"]["integrator"] == "implicit"

    saved, own = str(tmp_path / "part" / "checkpoint.pt"), ("mass=0.9:1.1",)
    state = torch.load(saved, weights_only=True)
    torch.save(state | {"args": state["args"] | {"randomise": own}}, saved)
    for flags, ranges in (("--accuracy accurate", own), ("--contact soft", ()), ("", own)):
        assert parse(shac.Args, ["--evaluate", saved, *flags.split()]).randomise == ranges


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

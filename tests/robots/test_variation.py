"""Options after a task's name, and the factors of the constants over a training."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_same, refusal, run

import diffsim
import shac
from diffsim.robot.scene import FACTORS
from diffsim.tasks import TASKS, TaskError, find_task
from diffsim.training import parse
from diffsim_robots import variation
from diffsim_robots.terrain import uneven
from diffsim_robots.variation import REDRAW, Variation, on_a_plane


@pytest.fixture(scope="module")
def env() -> diffsim.DiffEnv:
    return diffsim.make("hopper:friction=0.5:2,mass=0.9:1.2,stiffness=1:4", 2000, contact="mujoco", factors=True)


def column(env: diffsim.DiffEnv, name: str) -> torch.Tensor:
    return env.sim.factors[:, FACTORS.index(name)]


def test_factors_are_drawn_for_each_environment_and_constant(env: diffsim.DiffEnv) -> None:
    """Uniform in the logarithm, and drawn anew when it is time."""
    variation = Variation(env, 1)
    variation.set(10 * REDRAW)
    drawn = env.sim.factors.log()
    for name, (least, most) in (("mu", (0.5, 2.0)), ("mass", (0.9, 1.2)), ("k_n", (1.0, 4.0)), ("d_limit", (1.0, 4.0))):
        logs, low, high = drawn[:, FACTORS.index(name)], math.log(least), math.log(most)
        assert low <= logs.min() < low + 0.02 and high - 0.02 < logs.max() <= high
        assert logs.mean() == pytest.approx((low + high) / 2, abs=0.05)
    assert (column(env, "motor") == 1).all()
    assert torch.corrcoef(drawn[:, [0, 1, 3]].T)[0, 1:].abs().max() < 0.1  # each constant by itself
    variation.set(10 * REDRAW + 1)
    first = env.sim.factors.clone()
    assert not torch.equal(first, drawn.exp())
    variation.set(11 * REDRAW)
    assert torch.equal(first, env.sim.factors)
    variation.set(11 * REDRAW + 1)
    assert not torch.equal(first, env.sim.factors)
    Variation(env, 1).set(10 * REDRAW + 5)  # of the iteration alone
    assert torch.equal(first, env.sim.factors)
    Variation(env, 2).set(10 * REDRAW + 5)
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
    "env, message",
    [
        ("hopper:", "task 'hopper' has no option '': write rough=20, randomise=none or a range like friction=0.7:1.3"),
        ("hopper:friction", "task 'hopper' has no option 'friction': write rough=20, randomise=none or a range like"),
        ("hopper:friction=1", "task 'hopper' has no option 'friction=1': write rough=20"),
        ("hopper:friction=a:b", "task 'hopper' has no option 'friction=a:b': write rough=20"),
        ("hopper:randomise=all", "task 'hopper' has no option 'randomise=all': write rough=20"),
        ("hopper:mu=0.5:1", "task 'hopper' cannot vary 'mu': choose from friction, stiffness, mass, motor"),
        ("hopper:mass=0:1", "'mass=0:1': factors must be positive and finite, the smaller one first"),
        ("hopper:mass=2:1", "the smaller one first"),
        ("hopper:mass=1:inf", "positive and finite"),
        ("hopper:mass=nan:2", "positive and finite"),
        *(
            (f"hopper:rough={slope}", f"'rough={slope}': the steepest slope must be above 0 and at most 45 degrees")
            for slope in ("0", "-1", "45.1", "inf", "nan", "steep", "")
        ),
        ("ant:push=0:1", "task 'ant' cannot vary 'push': choose from friction, stiffness, mass, motor"),
        ("go2:latency=0:3", "'latency=0:3': must be from 0 to 2, the smaller one first"),
        ("go2:push=1:0.5", "'push=1:0.5': must be from 0 to inf, the smaller one first"),
        ("go2:push=0:inf", "must be from 0 to inf"),
        ("go2:mu=1:2", "choose from friction, stiffness, mass, motor, latency, push, pull"),
        ("g1_track:pull=0:1", "task 'g1_track' cannot vary 'pull': choose from friction, stiffness, mass, motor, push"),
        (
            "g1_track:mass=1",
            "task 'g1_track' has no option 'mass=1': write a clip, rough=20, randomise=none or a range",
        ),
        ("nothing:rough=20", "unknown task 'nothing:rough=20': choose from cartpole, hopper"),
    ],
)
def test_wrong_options_are_one_line(env: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(TaskError, match=re.escape(message)):
        find_task(env)
    assert message in refusal(lambda: shac.main(["--env", env]), capsys)


def ranges(name: str) -> dict[str, tuple[float, float]]:
    return dict(find_task(name).ranges)  # type: ignore[attr-defined]


def test_options_replace_the_ranges_of_the_task_by_name() -> None:
    own = ranges("go2")
    assert len(own) == 6 and ranges("go2:friction=0.5:2") == own | {"friction": (0.5, 2.0)}
    assert ranges("go2:stiffness=1:2,push=0:2") == own | {"stiffness": (1.0, 2.0), "push": (0.0, 2.0)}
    assert ranges("go2:randomise=none") == {} and ranges("go2:rough=20") == own
    assert ranges("go2:randomise=none,mass=0.9:1.1") == ranges("hopper:mass=0.9:1.1") == {"mass": (0.9, 1.1)}
    assert ranges("g1_track:g1_jazz_walk,mass=0.9:1.1") == ranges("g1_track") | {"mass": (0.9, 1.1)}
    for name in ("go2", "go2:friction=0.5:2", "hopper:mass=1:1.1", "go2:rough=20"):
        assert find_task(name).varied_by == "diffsim_robots.variation:Variation"
    for name in ("hopper", "hopper:rough=20", "go2:randomise=none", "g1_track:randomise=none,g1_jazz_walk"):
        assert find_task(name).varied_by is None
    assert ranges("go2") == own  # the options of others do not change the task


def test_a_task_of_a_class_can_be_configured() -> None:
    """It is another class of the same name, and stays what it was."""
    kind = TASKS["hopper"].configured("rough=10,mass=0.9:1.1")
    assert kind.name == "hopper" and kind.__name__ == "Hopper" and issubclass(kind, TASKS["hopper"])
    env = diffsim.make(kind, 2, seed=3)
    np.testing.assert_array_equal(env.scene.terrain, uneven(10.0, 2, 3))
    assert TASKS["hopper"].terrain(2, 3) is None


def test_a_name_without_rough_ground() -> None:
    for name, plane in (
        ("go2", "go2"),
        ("go2:rough=20", "go2"),
        ("g1_track:rough=20,walk.npz,push=0:1", "g1_track:walk.npz,push=0:1"),
        ("my_task.py:Class", "my_task.py:Class"),
    ):
        assert on_a_plane(name) == plane


def test_disturbances_are_the_tasks() -> None:
    """Drawn in each episode of a training, not without one; only joystick tasks have some."""
    env = diffsim.make("go2:randomise=none,latency=0.5:1,push=0:0.5,mass=0.9:1.1", 300, factors=True)
    assert (env.memory[:, -6] == 0).all() and env.task.disturbances["push"] == (0.0, 0.0)
    Variation(env, 1).set(1)
    late = env.memory[:, -6]
    assert 0.5 <= late.min() < 0.6 and 0.9 < late.max() <= 1 and env.task.disturbances["push"] == (0.0, 0.5)
    assert column(env, "mass").std() > 0.01 and (column(env, "motor") == 1).all()
    assert diffsim.make("go2", 1).task.disturbances["push"] == (0.0, 0.0)


@pytest.mark.unoptimized
def test_runs_that_vary_resume_bitwise_and_are_evaluated_on_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect, seen = shac.collect, list[torch.Tensor]()

    def watched(env: diffsim.DiffEnv, *rest: Any) -> shac.Rollout:
        seen.append(env.sim.factors.clone())
        return collect(env, *rest)

    monkeypatch.setattr(shac, "collect", watched)
    monkeypatch.setattr(variation, "REDRAW", 1)
    flags = "--env hopper:mass=0.9:1.1,friction=0.5:2 --contact mujoco --num-envs 16 --horizon 8 --iterations 4"
    flags += " --eval-episodes 2 --device cpu --critic-iterations 2 --threads 1 --quiet"
    whole = run(shac, tmp_path / "whole", *flags.split())
    assert len(seen) == 4 and not any(torch.equal(a, b) for a, b in pairwise(seen))
    assert all((factors[:, FACTORS.index("mass")] != 1).all() for factors in seen)
    run(shac, tmp_path / "part", *flags.split(), stop_after=2)
    part = run(shac, tmp_path / "part", "--resume", tmp_path / "part" / "checkpoint.pt", "--quiet")
    assert_same(part["modules"], whole["modules"])
    assert whole["args"]["contact"] == "mujoco"
    saved = str(tmp_path / "part" / "checkpoint.pt")
    assert parse(shac.Args, ["--evaluate", saved, "--accuracy", "accurate"]).substeps == 16

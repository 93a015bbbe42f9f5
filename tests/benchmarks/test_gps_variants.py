"""benchmarks/gps_variants.py: the variants of Figure 2, terrains by their names, planning and the search over them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gps_variants
import numpy as np
import pytest
import torch
from gps_variants import Ground, named_terrains
from learners import assert_same, refusal, run
from planning.systems import jacobian_errors
from scenes import task_scene

import diffsim
from diffsim.planning import save_demonstration
from diffsim.sim.elevation import Elevation
from diffsim.training import parse
from diffsim_cli import render
from diffsim_cli.watch import film_median
from diffsim_robots.terrain import incline, rough

SLOPES = "level", "incline:15:-1", "incline:-15:-1"  # all but the first begin behind the start
SMALL = (
    "--env hopper --horizon 8 --pretraining 5 --hidden 8 --guiding-samples 6 --samples 6 --active 12 "
    "--lbfgs-iterations 2 --iterations 2 --eval-every 0 --eval-episodes 2 --quiet"
).split()


def hopper(**options: Any) -> diffsim.DiffEnv:
    return diffsim.make("hopper", 1, dtype=torch.float64, substeps=8, **options)


def make_search(*flags: str) -> gps_variants.Search:
    args = parse(gps_variants.VariantArgs, [*SMALL, "--device", "cpu", *flags])
    return gps_variants.Search(args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))


# Names ----------------------------------------------------------------------------------------------------------------


def test_terrains_by_their_names() -> None:
    for name, profile in {
        "level": incline(0.0),
        "incline:5:1.4": incline(5.0, start=1.4),
        "rough:8": rough(0, degrees=8.0),
        "rough:8:2:7": rough(7, 2.0, 8.0),
    }.items():
        np.testing.assert_array_equal(named_terrains(name), profile[None])


def test_terrains_in_one_array_keep_their_heights() -> None:
    names = "incline:10", "rough:10:25"
    stacked, x = named_terrains(*names), np.linspace(-2.0, 60.0, 200)
    qpos = torch.zeros(len(x), 6).double()
    qpos[:, 0] = torch.tensor(x)
    for name, profile in zip(names, stacked, strict=True):
        scenes = (task_scene("hopper").with_terrain(vertices) for vertices in (named_terrains(name), profile))
        one, two = (Elevation(scene, "cpu", torch.float64).height(qpos) for scene in scenes)
        torch.testing.assert_close(one, two)
        assert one.abs().max() > 0.25


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--terrain hill", "terrain 'hill' must be level, incline:DEGREES"),
        ("--terrain level:1", "terrain 'level:1' must be level, incline:DEGREES"),
        ("--terrain rough:ten", "could not convert string to float: 'ten'"),
        ("--terrain incline:100", "degrees is 100.0"),
        ("--terrain level incline:1 incline:2 --samples 2", "--samples and --guiding-samples must be at least 3"),
        ("--terrain level incline:1 --adaptive 1", "--adaptive takes one --terrain"),
        ("--terrain incline:1", "hopper.npz has no trajectory over incline:1, only over level"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refusal(lambda: gps_variants.main(["--env", "hopper", *arguments.split()]), capsys)


# Planning over them ---------------------------------------------------------------------------------------------------


def test_states_and_jacobians_are_over_the_ground() -> None:
    """On a slope that begins behind the start: the environment's."""
    profile = incline(15.0, start=-2.0)
    env = hopper(terrain=profile, stochastic_init=False, horizon=1)
    system = Ground(hopper(), profile)
    start = torch.cat((env.qpos, env.qvel), 1)
    assert start[0, 1] > 0.4 + system.start()[0, 1]
    torch.testing.assert_close(system.observe(system.start()), env.reset()[0])
    u = torch.full((1, 3), 0.1).double()
    x, _, _ = system.rollout(system.start(), 40, lambda t, _: u)
    lifted = Elevation(system.scene, "cpu", torch.float64).lift(x[0, :, :6])
    torch.testing.assert_close(lifted[0], start[0, :6])
    for t in range(1, 41):
        obs, reward, *_ = env.step(torch.tanh(u))
        torch.testing.assert_close(lifted[t], env.qpos[0])
        torch.testing.assert_close(system.reward(x[:, t], u), reward)
        torch.testing.assert_close(system.observe(x[:, t]), obs)
    assert jacobian_errors(system, x[0, 30:40:3], u.expand(4, -1)).max() < 1e-4


def test_several_terrains_at_once() -> None:
    """Trajectory i goes over terrain i % M, and a controller gets its state over that."""
    profiles = named_terrains("incline:15:-1", "rough:10:1:3", "incline:-10:0.05")
    together, seen = Ground(hopper(), profiles), list[torch.Tensor]()
    start = together.start().repeat(5, 1)
    start[3:, :2] += torch.tensor([0.3, 0.1])

    def act(_: int, x: torch.Tensor) -> torch.Tensor:
        seen.append(x)
        return 0.5 * x[:, 6:9]

    x, u, finite = together.rollout(start, 30, act)
    assert finite.all() and torch.equal(torch.stack(seen, 1), x[:, :-1])
    for i in range(5):
        one = Ground(hopper(), profiles[i % 3]).rollout(start[i : i + 1], 30, act)
        assert torch.equal(one[0][0], x[i]) and torch.equal(one[1][0], u[i])
    with pytest.raises(ValueError, match="Jacobians need one terrain"):
        together.jacobians(x[:, 0], u[:, 0])


# The search -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def slopes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An example over each of SLOPES."""
    system, found = make_search(), []
    for name in SLOPES:
        ground = Ground(hopper(control_dt=0.02), named_terrains(name))
        noise = 0.2 * torch.randn(8, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        found.append(ground.rollout(ground.start(), 8, lambda t, _, noise=noise: noise[t : t + 1])[:2])
    x, u = (torch.cat(parts) for parts in zip(*found, strict=True))
    path = tmp_path_factory.mktemp("examples") / "slopes.npz"
    save_demonstration(system.system, x, u, path, terrain=SLOPES)
    return path


def test_a_search_on_several_terrains(tmp_path: Path, slopes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A guide on each, which is sampled there; trajectory i of the policy goes over terrain i % 3."""
    search = make_search("--terrain", *SLOPES, "--demonstration", str(slopes))
    search.prepare(lambda message: None)
    search.iterate(1)
    assert len(search.guides) == search.initial == 3
    monkeypatch.setattr(search, "noise", lambda count, rng=None: torch.zeros(count, 8, 3).double())
    S, own = search.follow(search.guides, 6), search.draw(search.network.theta)
    for i, guide in enumerate(search.guides):
        assert (S.source == i).sum() == 2
        torch.testing.assert_close(S.x[S.source == i], guide.x.expand(2, -1, -1))
        with monkeypatch.context() as patch:
            patch.setattr(search, "system", search.grounds[i])
            alone = search.roll_out(search.network.theta, search.noise(1), guide.x[:1])
        torch.testing.assert_close(own.x[i::3], alone.x.expand(2, -1, -1))
    assert not any(torch.allclose(own.x[0], own.x[i]) for i in (1, 2))
    again = make_search("--terrain", *SLOPES[::-1], "--demonstration", str(slopes))
    again.prepare(lambda message: None)
    for made, guide in zip(again.guides, search.guides, strict=True):  # in the order of the examples
        torch.testing.assert_close(made.x, guide.x)
    evaluation = search.evaluate()
    world = evaluation.qpos[0, :, 1] - search.guides[0].x[0, 1]
    torch.testing.assert_close(world, torch.tensor([0.0, 1.0]).double() * math.tan(math.radians(15.0)))
    films: list[Any] = []
    monkeypatch.setattr(render, "film", lambda path, scene, *_, **__: films.append(scene.terrain))
    evaluation.returns = torch.tensor([1.0, 0.0])  # of two, the worse one is filmed
    film_median(evaluation, tmp_path / "video.mp4")
    np.testing.assert_allclose(films[-1][0, :3], named_terrains(SLOPES[1])[0])


def test_a_resumed_search_is_the_same(tmp_path: Path, slopes: Path) -> None:
    flags = [*SMALL, "--terrain", *SLOPES[:2], "--demonstration", slopes]
    whole = run(gps_variants, tmp_path / "whole", *flags)
    run(gps_variants, tmp_path / "parts", *flags, stop_after=1)
    gps_variants.main(["--resume", str(tmp_path / "parts" / "checkpoint.pt")])
    parts = torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)
    assert_same(parts["modules"], whole["modules"])


# The variants ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", list(gps_variants.CASES))
def test_variants(case: str, tmp_path: Path) -> None:
    modules = run(gps_variants, tmp_path, *SMALL, "--case", case)["modules"]
    search, S = modules["learner"], modules["S"]
    guided = case in ("guided", "one-start", "effective-samples")
    assert any(len(generator) > 1 for generator in S["generators"]) == guided == (search["initial"] == 1)
    moved = not torch.equal(modules["network"]["theta"], S["generators"][search["best"]][0])
    assert moved == (case in ("policy-gradient", "dagger"))


def test_effective_samples_are_bounded_from_below() -> None:
    """Phi falls by the square of what is missing to LEAST, at each step."""
    search = gps_variants.EffectiveSamples(make_search().args, diffsim.make("hopper", 1))
    log_pi, reward = torch.zeros(12, 4).double(), torch.ones(12, 4).double()
    even, alone = torch.zeros(12, 4).double(), 99.0 * (torch.arange(12) > 0).double()[:, None].expand(12, 4)
    value = search.objective(even, reward)(log_pi)
    assert value.item() == pytest.approx(4.0)
    assert search.objective(alone, reward)(log_pi).item() == pytest.approx(4.0 - 4 * (gps_variants.LEAST - 1) ** 2)


def test_restarts_begin_anywhere_on_the_guides(tmp_path: Path) -> None:
    search = gps_variants.Restart(make_search().args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))
    search.prepare(lambda message: None)
    path, starts = search.guides[0].x[:-1], search.draw(search.network.theta, count=40).x[:, 0]
    assert torch.cdist(starts, path).min(1).values.max() == 0 and len(starts.unique(dim=0)) > 4


def test_a_single_example_has_no_noise() -> None:
    """Its policy acts at the example's states as the example does, however the guides' samples differ."""
    args = make_search("--pretraining", "300").args
    search = gps_variants.SingleExample(args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))
    search.prepare(lambda message: None)
    guide, policy = search.guides[0], search.network
    error = (policy.mean(policy.theta, search.system.observe(guide.x[:-1])) - guide.u) / policy.sigma
    assert error.abs().max() < 0.05

"""benchmarks/guided_policy_search.py: variants of Figure 2, terrains, what lasts and walks, and examples."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import common
import guided_policy_search as benchmark
import numpy as np
import pytest
import torch
from guided_policy_search import Ground, named_terrains
from learners import ROOT, SMALL, assert_same, refusal, run
from planning.systems import jacobian_errors
from scenes import task_scene
from suites import SUITES
from tables import read_csv

import diffsim
import gps
import shac
from diffsim.planning import System, load_demonstration, save_demonstration
from diffsim.sim.elevation import Elevation
from diffsim.training import parse
from diffsim.training.evaluation import make_env
from diffsim_cli import render
from diffsim_cli.watch import film_median
from diffsim_robots.terrain import incline, rough

SLOPES = "level", "incline:15:-1", "incline:-15:-1"  # all but the first begin behind the start
HOPPER = (
    "--env hopper --horizon 8 --pretraining 5 --hidden 8 --guiding-samples 6 --samples 6 --active 12 "
    "--lbfgs-iterations 2 --iterations 2 --eval-every 0 --eval-episodes 2 --quiet"
).split()


def hopper(**options: Any) -> diffsim.DiffEnv:
    return diffsim.make("hopper", 1, dtype=torch.float64, substeps=8, **options)


def make_search(*flags: str) -> benchmark.Search:
    args = parse(benchmark.VariantArgs, [*HOPPER, "--device", "cpu", *flags])
    return benchmark.Search(args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))


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
    assert message in refusal(lambda: benchmark.main(["--env", "hopper", *arguments.split()]), capsys)


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
    monkeypatch.setattr(search.rollouts, "noise", lambda count, rng=None: torch.zeros(count, 8, 3).double())
    S, own = search.rollouts.follow(search.guides, search.grounds, 6), search.rollouts.draw(search.network.theta)
    for i, guide in enumerate(search.guides):
        assert (S.source == i).sum() == 2
        torch.testing.assert_close(S.x[S.source == i], guide.x.expand(2, -1, -1))
        with monkeypatch.context() as patch:
            patch.setattr(search.rollouts, "system", search.grounds[i])
            alone = search.rollouts.roll_out(search.network.theta, search.rollouts.noise(1), guide.x[:1])
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
    flags = [*HOPPER, "--terrain", *SLOPES[:2], "--demonstration", slopes]
    whole = run(benchmark, tmp_path / "whole", *flags)
    run(benchmark, tmp_path / "parts", *flags, stop_after=1)
    benchmark.main(["--resume", str(tmp_path / "parts" / "checkpoint.pt")])
    parts = torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)
    assert_same(parts["modules"], whole["modules"])


# The variants ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", list(benchmark.CASES))
def test_variants(case: str, tmp_path: Path) -> None:
    modules = run(benchmark, tmp_path, *HOPPER, "--case", case)["modules"]
    search, S = modules["learner"], modules["S"]
    guided = case in ("guided", "one-start", "effective-samples")
    assert any(len(generator) > 1 for generator in S["generators"]) == guided == (search["initial"] == 1)
    moved = not torch.equal(modules["network"]["theta"], S["generators"][search["best"]][0])
    assert moved == (case in ("policy-gradient", "dagger"))


def test_effective_samples_are_bounded_from_below() -> None:
    """Phi falls by the square of what is missing to LEAST, at each step."""
    search = benchmark.EffectiveSamples(make_search().args, diffsim.make("hopper", 1))
    log_pi, reward = torch.zeros(12, 4).double(), torch.ones(12, 4).double()
    even, alone = torch.zeros(12, 4).double(), 99.0 * (torch.arange(12) > 0).double()[:, None].expand(12, 4)
    value = search.objective(even, reward)(log_pi)
    assert value.item() == pytest.approx(4.0)
    assert search.objective(alone, reward)(log_pi).item() == pytest.approx(4.0 - 4 * (benchmark.LEAST - 1) ** 2)


def test_restarts_begin_anywhere_on_the_guides(tmp_path: Path) -> None:
    search = benchmark.Restart(make_search().args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))
    search.prepare(lambda message: None)
    path, starts = search.guides[0].x[:-1], search.rollouts.draw(search.network.theta, count=40).x[:, 0]
    assert (starts[:, None] == path).all(-1).any(1).all() and len(starts.unique(dim=0)) > 4


def test_a_single_example_has_no_noise() -> None:
    """Its policy acts at the example's states as the example does, however the guides' samples differ."""
    args = make_search("--pretraining", "3000").args
    search = benchmark.SingleExample(args, diffsim.make("hopper", 1, control_dt=0.02, substeps=20))
    search.prepare(lambda message: None)
    guide, policy = search.guides[0], search.network
    error = (policy.mean(policy.theta, search.system.observe(guide.x[:-1])) - guide.u) / policy.sigma
    assert error.abs().max() < 0.5


# What lasts, and what walks over terrain ------------------------------------------------------------------------------


TINY = (
    "--env hopper --horizon 12 --pretraining 5 --hidden 8 --samples 2 --guiding-samples 4 --active 8 --iterations 1 "
    "--lbfgs-iterations 2 --eval-every 0 --eval-episodes 1 --quiet"
).split()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "hopper__full__1"
    run(gps, directory, *TINY)
    return directory


@pytest.fixture
def search(trained: Path) -> gps.Search:
    return benchmark.load_search(trained / "checkpoint.pt")


def test_the_command(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guide hops over level ground; a second call draws from the csv file alone."""
    monkeypatch.setattr(benchmark, "terrains", lambda env: {"some": ["level", "incline:60:-1"]})
    benchmark.walk(benchmark.RunArgs(checkpoints=(trained,), output=tmp_path))
    rows = {(row["terrain"], row["controller"]): row for row in read_csv(tmp_path / "gps_controllers.csv")}
    assert (
        len(rows) == 6 and rows["level", "ddp 1"]["walked"] == "1" and rows["incline:60:-1", "ddp 1"]["walked"] == "0"
    )
    before = (tmp_path / "gps_controllers.csv").read_bytes()
    benchmark.walk(benchmark.RunArgs(draw_only=True, output=tmp_path))
    assert before == (tmp_path / "gps_controllers.csv").read_bytes()


def test_who_falls_or_stays_behind_has_not_walked(search: gps.Search) -> None:
    x = search.guides[0].x.expand(4, -1, -1).clone()
    finite = torch.ones(4, 12, dtype=torch.bool)
    x[1, 5, 1] = x[1, 0, 1] - benchmark.FALL - 0.01  # it falls, and stands up again
    finite[2, 3] = False
    x[3, -1, 0] = 0.89 * x[3, -1, 0]
    assert benchmark.walked(search, x, finite).tolist() == [True, False, False, False]


def test_controllers_by_time_and_by_what_looks_alike(search: gps.Search) -> None:
    guide, act = search.guides[0], benchmark.controllers(search)
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9]), guide.u[8:9])
    torch.testing.assert_close(act["ddp 1"](8, guide.x[8:9]), guide.u[8:9])
    assert not torch.equal(act["ddp 1"](0, guide.x[8:9]), guide.u[8:9])
    away = torch.zeros_like(guide.x[8:9])
    away[0, 0], away[0, 4] = 3.0, 1e-4  # the place does not count
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9] + away), guide.u[8:9] + 1e-4 * guide.K[8, :, 4])


@pytest.mark.parametrize(("env", "rough"), [("humanoid", 1), ("walker", 3)])
def test_terrains_are_eight_places_and_four_grounds_of_each_steepness(env: str, rough: int) -> None:
    found = benchmark.terrains(env)
    assert [len(names) for names in found.values()] == [8, *[4] * rough]
    assert len({named_terrains(name).tobytes() for names in found.values() for name in names}) == 8 + 4 * rough


def test_the_table_has_the_best_guide_of_each_training() -> None:
    shares = {"1": {"policy": 1.0, "ddp 1": 0.0, "ddp 2": 0.5, "tbdp": 0.1}, "2": {"policy": 0.0, "ddp 1": 1.0}}
    shares["2"] |= {"ddp 2": 0.0, "tbdp": 0.3}
    about = {"kind": "rough", "variant": "full"}
    rows = [about | {"seed": s, "controller": c, "walked": f"{x}"} for s, own in shares.items() for c, x in own.items()]
    assert benchmark.table(rows) == [{"over": "rough", "full": "50% / 75% / 20%"}]


def test_what_lasts_is_looked_at_for_three_horizons(trained: Path, tmp_path: Path) -> None:
    """And with three times the noise; a short walk of the first horizon is too short for all three."""
    benchmark.last(benchmark.RunArgs(checkpoints=(trained,), output=tmp_path))
    rows = read_csv(tmp_path / "gps_lasting.csv")
    assert [(row["noise"], row["trajectories"], row["steps"]) for row in rows] == [
        ("1", "100", "12"),
        ("3", "100", "12"),
    ]
    search = benchmark.load_search(trained / "checkpoint.pt")
    x = search.guides[0].x
    longer = torch.cat((x, x[-1:].expand(24, -1)))[None]
    finite = torch.ones(1, 36, dtype=torch.bool)
    assert benchmark.walked(search, longer[:, :13], finite[:, :12]).all()
    assert not benchmark.walked(search, longer, finite).any()


def test_the_table_of_tasks_has_a_line_for_each_example() -> None:
    runs = [
        {"group": "hopper", "cell": cell, "guides": "-87", "pretrained": "-120", "end": end, "core_seconds": "80"}
        for cell, end in (("full", "-90"), ("full", "-88.5"), ("restart", "-1000"), ("ddp", "-99"))
    ]
    about = {"group": "hopper", "cell": "full", "seed": "1"}
    lasting = [about | {"noise": factor, "walked 3": share} for factor, share in (("1", "1"), ("3", "0.25"))]
    first, second = benchmark.tasks(runs, lasting)
    assert first["task"] == "hopper" and first["search"] == "-90.0 to -88.5" and first["guides"] == "-87.0"
    assert first["seeds"] == 2 and first["lasts, noise x 1 / x 3"] == "100% / 25%"
    assert second["task"] == "hopper, plan of iLQR" and second["search"] == "-99.0"


# The picture ----------------------------------------------------------------------------------------------------------


def test_it_is_drawn_from_the_csv_file(tmp_path: Path) -> None:
    shutil.copy(common.RESULTS / "cpu" / "gps_runs.csv", tmp_path)
    benchmark.plot(common.CommonFlags(output=tmp_path))
    assert (tmp_path / "gps_runs.png").read_bytes()[:4] == b"\x89PNG"


def test_every_variant_of_a_group_has_its_name() -> None:
    rows = read_csv(common.RESULTS / "cpu" / "gps_runs.csv")
    shown = {row["cell"] for row in rows if row["group"] == benchmark.SHORT}
    assert shown <= {*benchmark.NAMES} <= {*SUITES["gps"].cells}


# Examples -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env", gps.PER_TASK)
def test_each_shipped_example_is_a_motion_of_its_robot(env: str) -> None:
    """The simulator follows it to its end."""
    args = parse(gps.Args, ["--env", env, "--device", "cpu"])
    search = gps.Search(args, make_env(args, 1))
    ((system, x, u),) = search.examples()
    plan = search.plan(system, x, u)
    torch.testing.assert_close(plan.x[0, :, : system.nq], x[:, : system.nq], rtol=0.0, atol=0.05)


@pytest.mark.parametrize("task", [benchmark.HopperExample, benchmark.WalkerExample])
def test_tasks_of_examples_have_the_reward_of_gps(task: type[benchmark.Hopper]) -> None:
    """But for what a step without error earns, and actions after tanh."""
    name = task.name.removesuffix("_example")
    args = parse(gps.Args, ["--env", name, "--device", "cpu"])
    search = gps.Search(args, make_env(args, 1))
    assert (task.control_dt, task.substeps) == (args.control_dt, args.substeps)
    own = System(diffsim.make(task, 1, control_dt=args.control_dt, substeps=args.substeps))
    x = search.system.start() + 0.05 * torch.randn(6, search.system.nx, generator=torch.Generator().manual_seed(1))
    still = torch.zeros(6, search.system.nu, dtype=torch.float64)
    torch.testing.assert_close(own.reward(x, still), benchmark.ALIVE + search.rollouts.reward(x, still))


def test_a_recorded_policy(tmp_path: Path) -> None:
    """Its states follow from its actions."""
    run(shac, tmp_path / "run", *SMALL["shac"])
    benchmark.record(benchmark.RecordArgs(to=tmp_path / "one.npz", env="cartpole", run=tmp_path / "run", steps=12))
    system = System(diffsim.make("cartpole", 1))
    ((x, u),) = load_demonstration(system, tmp_path / "one.npz", 12)
    played, _, _ = system.rollout(x[:1], 12, lambda t, _: u[t : t + 1])
    torch.testing.assert_close(played[0], x, rtol=0.0, atol=1e-5)


def test_the_other_leg_first(tmp_path: Path) -> None:
    """The shipped walks begin in one state with different actions, and both are motions of the robot."""
    benchmark.record(benchmark.RecordArgs(to=tmp_path / "both.npz", exchange=gps.EXAMPLES / "walker.npz"))
    args = parse(gps.Args, ["--env", "walker", "--device", "cpu", "--demonstration", str(tmp_path / "both.npz")])
    search = gps.Search(args, make_env(args, 1))
    one, other = search.examples()
    shipped = ROOT / "benchmarks" / "plans" / "walker_both.npz"
    for (x, u), (_, *found) in zip(load_demonstration(search.system, shipped, args.horizon), (one, other), strict=True):
        torch.testing.assert_close([x, u], found)
    assert torch.equal(one[1][0], other[1][0]) and (one[2][0] - other[2][0]).abs().max() > 0.5
    plans = [search.plan(*each) for each in (one, other)]
    torch.testing.assert_close(plans[0].cost, plans[1].cost, rtol=1e-9, atol=0.0)


def test_a_swimmer_swims_forward(tmp_path: Path) -> None:
    benchmark.record(benchmark.RecordArgs(to=tmp_path / "swim.npz", env="swimmer", steps=60, settle=200))
    x = np.load(tmp_path / "swim.npz")["qpos"][:, 0]
    assert x[0] == 0.0 and x[-1] > 0.6 * 60 * 0.05


def test_without_a_run_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = benchmark.RecordArgs(to=tmp_path / "a.npz", env="hopper")
    assert "--run must be the directory of a run" in refusal(lambda: benchmark.record(args), capsys)

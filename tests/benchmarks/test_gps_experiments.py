"""benchmarks/gps_experiments.py on a small run."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import gps_experiments as experiments
import gps_variants
import numpy as np
import pytest
import torch
from common import DOCS, RESULTS
from learners import run
from tables import markdown, read_csv, write_csv

import bptt
import diffsim
import gps
from diffsim import training

SMALL = (
    "--env cartpole --horizon 12 --restarts 2 --screening 2 --ilqr-iterations 10 --pretraining 20 --hidden 8 "
    "--guiding-samples 8 --samples 4 --active 16 --stored 24 --iterations 1 "
    "--lbfgs-iterations 3 --eval-episodes 2 --quiet"
).split()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs")
    path = directory / "cartpole__full__1"
    run(gps, path, *SMALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiments, "COUNT", 4)
        rows = list(experiments.generalisation(experiments.load_search(path / "checkpoint.pt")))
    write_csv(path / "generalisation.csv", rows)
    return directory


def test_table_and_pictures(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a run; a second time from the csv files alone."""
    options = ["--output", str(tmp_path / "results"), "--figures", str(tmp_path / "figures"), "--draw-only"]
    experiments.main([*options, "--runs", str(runs)])
    rows = read_csv(tmp_path / "results" / "gps_generalisation.csv")
    assert {row["controller"] for row in rows} == {"policy", "ddp", "tbdp"}
    plan = experiments.load_search(runs / "cartpole__full__1" / "checkpoint.pt").plan_return
    ddp = next(row for row in rows if row["controller"] == "ddp" and float(row["size"]) == 0)
    assert float(ddp["mean"]) == pytest.approx(plan, rel=1e-9)  # unperturbed, it repeats the plan
    first = capsys.readouterr().out
    assert "| cartpole | full | 12 |" in first
    before = {path: path.read_bytes() for path in (tmp_path / "results").iterdir()}
    experiments.main([*options, "--runs", str(tmp_path / "nowhere")])
    assert before == {path: path.read_bytes() for path in (tmp_path / "results").iterdir()}
    assert capsys.readouterr().out == first and len(list((tmp_path / "figures").glob("gps_*.png"))) == 2


def test_runs_that_were_stopped_before_an_evaluation_are_not_shown() -> None:
    row = dict(env="hopper", variant="full", horizon="500", gps_guides="-3", gps_objective="-4", iteration="1")
    rows = [row | dict(seed=seed, eval_objective=value) for seed in "12" for value in ("", "-2.5" * (seed == "1"), "")]
    (line,) = experiments.table(rows)
    assert line["end, each seed"] == "-2.5"
    assert experiments.table(rows[3:]) == []


def test_nearest_controller_acts_by_the_step_that_looks_most_alike(runs: Path) -> None:
    search = experiments.load_search(runs / "cartpole__full__1" / "checkpoint.pt")
    guide, act = search.guides[0], experiments.controllers(search)
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9]), guide.u[8:9])
    torch.testing.assert_close(act["ddp"](8, guide.x[8:9]), guide.u[8:9])
    assert not torch.equal(act["ddp"](0, guide.x[8:9]), guide.u[8:9])


def test_a_push_moves_the_state_before_its_step(runs: Path) -> None:
    """A quarter of the time in; a controller keeps its clock, and what left the finite numbers stays."""
    search = experiments.load_search(runs / "cartpole__full__1" / "checkpoint.pt")
    system, start, seen = search.system, search.system.start().expand(2, -1), list[int]()
    kick = torch.tensor([[0.0, 0.0, 1.5, 0.0], [0.0, 0.0, -1.5, 0.0]]).double()

    def act(t: int, x: torch.Tensor) -> torch.Tensor:
        seen.append(t)
        return torch.tensor([[0.3], [math.nan if t == 1 else 0.3]]).double()

    x, u, finite = experiments.pushed(search, start, act, kick)
    assert seen == list(range(12)) and x.shape == (2, 13, 4) and u.shape == (2, 12, 1)
    assert finite.tolist() == [[True] * 12, [True] + [False] * 11]
    plain = system.rollout(start[:1], 12, lambda t, _: u[:1, t])[0]
    torch.testing.assert_close(x[0, :4], plain[0, :4])
    after = system.rollout(x[:1, 3] + kick[:1], 9, lambda t, _: u[:1, t])[0]
    torch.testing.assert_close(x[0, 4:], after[0, 1:])


def test_torques(runs: Path) -> None:
    """Of the plan's own controller they are the plan's; a motor's is its gear times tanh(u)."""
    search = experiments.load_search(runs / "cartpole__full__1" / "checkpoint.pt")
    rows = {(row["controller"], row["noise"]): row for row in experiments.torques(search)}
    assert len(rows) == 7 and rows["policy", "none"] != rows["policy", "policy"]
    force = search.guides[0].u.tanh() * float(search.system.scene.mj_model.actuator_gear[0, 0])
    ddp = rows["ddp", "none"]
    assert ddp["magnitude"] == pytest.approx(force.abs().mean().item(), rel=1e-6)
    assert ddp["square"] == pytest.approx(force.square().mean().item(), rel=1e-6)
    assert ddp["mean"] == pytest.approx(search.plan_return, rel=1e-9)


def test_weights_at_some_steps(runs: Path) -> None:
    """By products of densities, which a few steps allow; the guide as a policy would weigh its samples alike."""
    search = experiments.load_search(runs / "cartpole__full__1" / "checkpoint.pt")
    rows, S, policy = list(experiments.weights(search)), search.S.samples, search.network
    assert [row["step"] for row in rows] == [1, 2, 5, 10]
    mean = policy.mean(policy.theta, S.obs)
    away = (S.u - mean) / policy.sigma
    step = (-0.5 * away.square() - math.log(math.sqrt(2 * math.pi))).sum(-1) - policy.sigma.log().sum()
    density = torch.stack([search.S.log_density(g, S) for g in search.S.generators])
    used, guided, own = S.source.unique(), S.source == 0, (S.source == search.S.best).nonzero().flatten()[-4:]
    for row in rows:
        t = int(row["step"])
        weight = step[:, :t].sum(1).exp() / density[used, :, t - 1].exp().mean(0)
        share = weight / weight.sum()
        expected = dict(guides=weight[guided].log().mean(), own=weight[own].log().mean(), share=share[guided].sum())
        expected |= dict(effective=1 / share.square().sum(), away=away[guided, :t].square().mean().sqrt())
        expected["gap"] = (step[:, :t].sum(1) - density[0, :, t - 1])[guided].mean() / t
        expected["wide"] = (search.guides[0].L[:t, 0, 0] / policy.sigma).square().mean().sqrt()
        for name, value in expected.items():
            assert row[name] == pytest.approx(value.item(), rel=1e-6), name


def test_the_list_holds_a_command_for_each_run(capsys: pytest.CaptureFixture[str]) -> None:
    options = "--env hopper --cases full adaptive --seeds 1 2 --runs there".split()
    experiments.main([*options, "--list", "--", "--horizon", "160"])
    lines = capsys.readouterr().out.splitlines()
    part = "--env hopper --cases adaptive --seeds 2 --runs there --train-only -- --horizon 160"
    assert len(lines) == 6 and lines[-1] == f"python benchmarks/gps_experiments.py {part}"
    assert lines[0].startswith("python gps.py --env hopper") and lines[0].endswith("--run-dir runs/plans/hopper_500")
    assert experiments.CASES["adaptive"].startswith("--variant full --perturb 0 --adaptive")


def parse(env: str, case: str, *flags: str) -> None:
    words = [*experiments.CASES[case].split(), *flags]
    check(words, "--env", env)


def check(words: list[str], *others: str) -> None:
    """Whether their script takes the flags."""
    training.parse(experiments.ARGS[experiments.script(words).rpartition("/")[2]], [*words, *others])


def test_the_list_holds_the_runs_that_the_page_shows() -> None:
    """Of each task, case and seed in results/; a case that has other flags for a seed keeps them."""
    jobs = experiments.jobs(experiments.Args())
    runs = read_csv(RESULTS / "cpu" / "gps_runs.csv")
    assert {"__".join((row["env"], row["variant"], row["seed"])) for row in runs} <= jobs.keys()
    runs = read_csv(RESULTS / "cpu" / "gps_terrain.csv")
    assert {"__".join((row["env"], row["variant"], row["seed"])) for row in runs} <= jobs.keys()
    one, two, other = (experiments.jobs(experiments.Args(env=("swimmer",), seeds=(seed,))) for seed in (1, 2, 7))
    assert "200" in one["swimmer__feedback__1"] and "100" in two["swimmer__feedback__2"]
    assert other["swimmer__feedback__7"] == one["swimmer__feedback__1"]
    files = {path.stem for path in (experiments.ROOT / "benchmarks" / "plans").glob("*.npz")}
    assert files == {*experiments.PLANS, "swimmer_500", "humanoid_500", "walker_switch_300"}
    for flags in experiments.PLANS.values():
        check(flags.split())
    for env, case, *flags in {(*name.split("__")[:2], *flags) for name, flags in jobs.items()}:  # seeds share them
        parse(env, case, *flags)


def trained(runs: Path, name: str, flags: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    experiments.train(experiments.Runner(experiments.Args(runs=runs)), name, flags)
    return capsys.readouterr().out.splitlines()[-1]


def test_a_finished_run_is_kept(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {path: path.stat().st_mtime_ns for path in (runs / "cartpole__full__1").iterdir()}
    assert trained(runs, "cartpole__full__1", [], capsys) == "cartpole__full__1: done"
    assert files == {path: path.stat().st_mtime_ns for path in (runs / "cartpole__full__1").iterdir()}


def test_an_interrupted_run_goes_on(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Though its plan came from a file, which the checkpoint does not name."""
    directory = tmp_path / "cartpole__nonguided__1"
    first = ["--demonstration", str(runs / "cartpole__full__1" / "plan.npz"), *SMALL[2:], "--iterations", "2"]
    flags = [*first, *experiments.CASES["nonguided"].split()]
    run(gps_variants, directory, "--env", "cartpole", *flags, "--stop-after", "1")
    assert trained(tmp_path, directory.name, flags, capsys) == "cartpole__nonguided__1: done"
    assert len(read_csv(directory / "progress.csv")) == 3


def test_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What the policy of another script does, without a reset: a demonstration for gps.py."""
    run(bptt, tmp_path, *"--env cartpole --num-envs 2 --iterations 1 --eval-episodes 1 --substeps 2 --quiet".split())
    path, actor = tmp_path / "demo.npz", tmp_path / "checkpoint.pt"
    experiments.main(["--record", str(path), "--actor", str(actor), "--steps", "250"])
    data = np.load(path)
    assert data["qpos"].shape == (251, 2) and np.abs(np.diff(data["qpos"], axis=0)).max() < 1  # no reset
    qpos, qvel, action = (torch.tensor(data[name]) for name in ("qpos", "qvel", "action"))
    sim = diffsim.make("cartpole", 250, substeps=2).sim
    for value, expected in zip(sim.step(qpos[:-1], qvel[:-1], action), (qpos[1:], qvel[1:]), strict=True):
        torch.testing.assert_close(value, expected)
    search = run(gps, tmp_path / "gps", *SMALL, "--demonstration", path)["modules"]["learner"]
    assert search["guides"][0][0][0].tolist() == [*data["qpos"][0], *data["qvel"][0]]
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["gps_experiments.py"])
    with pytest.raises(SystemExit) as exit:
        experiments.main(["--record", str(path)])
    assert exit.value.code == 2 and "--record needs --actor" in capsys.readouterr().err


def test_the_page_has_the_table_of_the_csv_file() -> None:
    runs = read_csv(RESULTS / "cpu" / "gps_runs.csv")
    assert markdown(experiments.table(runs)) in (DOCS / "gps.md").read_text()

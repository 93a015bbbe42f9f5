"""The benchmark of learning: what it reads off the curves, and that an interrupted call goes on."""

from __future__ import annotations

import csv
import json
import subprocess
import time
from pathlib import Path

import common
import learning
import numpy as np
import pytest
import runner

from diffsim.training import checkpoint


def write_run(folder: Path, returns: np.ndarray, steps: int, seconds: float, finished: bool = True) -> None:
    """A run whose k-th iteration ends after k * steps control steps and k * seconds; its first has no episode's end."""
    folder.mkdir(parents=True)
    rows = [
        dict(iteration=k, control_steps=k * steps, seconds=k * seconds, length=1000, eval_return="")
        | {"return": value if k > 1 else ""}
        for k, value in enumerate(returns, start=1)
    ]
    if finished:
        rows[-1]["eval_return"] = returns[-1] + 100
        settings = dict(iteration=len(rows), integrator="semi_implicit", substeps=16)
        for path, value in ((folder, returns[-1] + 100), (folder / "explicit_64", returns[-1])):
            path.mkdir(exist_ok=True)
            found = {"return": value, "speed": 6.5, "lengths": [1000, 400], "settings": settings}
            (path / "evaluation.json").write_text(json.dumps(found))
    with (folder / "progress.csv").open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_page_compares_steps_and_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SHAC passes 5,000 at iteration 501, PPO at 2,501 of ten times the steps; BPTT never, and has not finished."""
    runs, output = tmp_path / "runs", tmp_path / "results" / "cpu"
    monkeypatch.setattr(common, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(common, "DOCS", tmp_path)
    (tmp_path / "experiments.md").write_text("<!-- comparison -->\n<!-- /comparison -->\n")
    for seed in (1, 2):
        write_run(runs / "shac" / f"ant__{seed}", np.arange(0, 7000, 10.0), 2048, 0.5)
        write_run(runs / "ppo_baseline" / f"ant__{seed}", np.arange(0, 6000, 2.0), 20480, 0.05)
    write_run(runs / "bptt" / "ant__1", np.arange(300.0), 4096, 0.5, finished=False)
    case = learning.Experiment("Learners", ("shac", "ppo_baseline", "bptt"), ("ant",))
    monkeypatch.setitem(learning.EXPERIMENTS, "comparison", case)
    args = learning.Args(experiment="comparison", env=("ant",), runs=runs, update_results=True, draw_only=True)
    learning.main(args)
    found = learning.table(args, case.learners, case.tasks)
    rows = {str(row["learner"]): {k: str(v) for k, v in row.items()} for row in found}
    shac, ppo, bptt = (rows[learner] for learner in ("shac", "ppo_baseline", "bptt"))
    assert shac["s to target"] == "250" and float(shac["steps to target"][:-2]) == pytest.approx(
        501 * 2048e-6, rel=1e-2
    )
    assert ppo["s to target"] == "125" and float(ppo["steps to target"][:-2]) == pytest.approx(
        2501 * 20480e-6, rel=1e-2
    )
    assert bptt["s to target"] == bptt["steps to target"] == "never" and bptt["last evaluation"] == ""
    assert ppo["best return of training"] == "5998 ± 0" and ppo["published"] == "6605"
    assert bptt["best return of training"] == "299" and bptt["seeds"] == "1"
    assert "| ppo_baseline | 2 | 5998 ± 0 |" in (tmp_path / "experiments.md").read_text()
    for path in (tmp_path / "figures" / "comparison.png", output / "bptt_ant.csv", output / "learning.csv"):
        assert path.stat().st_size > 0
    summary = {row["learner"]: row for row in args.read("learning")}
    assert list(summary) == ["shac", "ppo_baseline"]  # of finished runs
    shac = summary["shac"]
    assert (shac["seeds"], shac["iterations"], shac["training (s)"]) == ("1 2", "700", "350")
    assert (shac["return"], shac["explicit, substeps x4"], shac["in the reference"]) == ("7090", "6990", "6990")
    assert (shac["kept"], shac["falls per episode"]) == ("0.986", "0.50 0.50")
    assert shac["return passes"] == "5000 after 250 s; 7300 not; 7661 not"


def test_policies_are_compared_within_the_control_steps_that_all_made(tmp_path: Path) -> None:
    """At 3,100 steps, where a Gaussian run ends: 30 and 60 of PFPN, 15 and 30 of the Gaussian policy."""
    for policy, slopes in {"pfpn": (1.0, 2.0), "pfpn_gaussian": (0.5, 1.0)}.items():
        for seed, slope in enumerate(slopes):
            count = 31 if (policy, seed) == ("pfpn_gaussian", 1) else 50
            write_run(tmp_path / f"{policy}_ppo" / f"ant__{seed}", slope * np.arange(float(count)), 100, 0.5)
    write_run(tmp_path / "pfpn_sac" / "ant__1", np.arange(9.0), 100, 0.5)
    args = learning.Args(runs=tmp_path, output=tmp_path)
    for learner in ("pfpn_ppo", "pfpn_gaussian_ppo", "pfpn_sac"):
        learning.collect(args, learner, "ant")
    learners = "pfpn_ppo", "pfpn_gaussian_ppo", "pfpn_sac", "pfpn_gaussian_sac"
    assert learning.ratios(args, learners[1:], ("ant",)) == []
    (row,) = learning.ratios(args, learners, ("ant", "hopper"))
    assert row == {
        "task": "ant",
        "algorithm": "ppo",
        "control steps": "0.0031 M",
        "PFPN": "45 ± 15",
        "Gaussian": "22 ± 8",
        "PFPN / Gaussian": "2.00",
    }


def test_runs_that_shared_their_machine_have_no_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They count for everything else; of another machine a learner's steps are shown and no seconds."""
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    for seed in (1, 2):
        write_run(tmp_path / "runs" / f"ant__{seed}", np.arange(0, 7000, 10.0), 2048, 0.5)
    path = tmp_path / "runs" / "ant__2" / "progress.csv"
    rows = [row | {"seconds": ""} for row in learning.read_csv(path)]
    with path.open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    found = runner.summary(tmp_path / "runs", "ant", [5000])
    assert (found["seeds"], found["training (s)"], found["return passes"]) == ("1 2", "350", "5000 after 250 s")
    (tmp_path / "runs" / "ant__1").rename(tmp_path / "ant__1")
    found = runner.summary(tmp_path / "runs", "ant", [5000])
    assert (found["seeds"], found["training (s)"], found["return passes"]) == ("2", "", "")

    args = learning.Args(output=tmp_path / "h100")
    rows = [row | {"seed": "1"} for row in learning.read_csv(tmp_path / "ant__1" / "progress.csv")]
    common.tables.write_csv(tmp_path / "cpu" / "shac_ant.csv", rows)
    (curve,) = learning.curves(args, "shac", "ant")
    assert curve["control_steps"][-1] == 700 * 2048 and np.isnan(curve["seconds"]).all()
    cells = [{"learner": "bptt", "task": task} | row for row in rows for task in ("ant", "hopper")]
    common.tables.write_csv(tmp_path / "h100" / "curves.csv", cells)
    (curve,) = learning.curves(args, "bptt", "ant")
    assert len(curve["return"]) == len(rows) and curve["control_steps"][-1] == 700 * 2048
    assert not learning.curves(args, "sapo", "ant")


def test_a_return_that_some_seeds_pass() -> None:
    assert runner.words(5000, [100.0, 120.0, np.inf]) == "5000 after 120 s"
    assert runner.words(5000, [np.inf, 120.0, np.inf]) == "5000 by 1 of 3, after 120 s"


def test_a_stopped_call_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = dict(runs=tmp_path, output=tmp_path / "results", device="cpu")
    flags = "--num-envs", "2", "--horizon", "8", "--eval-every", "0", "--eval-episodes", "1", "--iterations"
    folder = tmp_path / "bptt" / "cartpole__1"
    case = runner.Case(folder, "cartpole", 1, "bptt")

    class Begun(subprocess.Popen[bytes]):
        """Its time counts from its first iterations: how long a script takes to start is the machine's business."""

        def wait(self, timeout: float | None = None) -> int:
            progress = folder / "progress.csv"
            while timeout is not None and self.poll() is None and not (progress.is_file() and progress.read_text()):
                time.sleep(0.05)
            return super().wait(timeout)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", Begun)
        args = learning.Args(**places, time_limit=1.0, arguments=(*flags, "100000"))
        assert not runner.Runner(args).train(case)
    done = checkpoint.load(folder / "checkpoint.pt")["iteration"]
    assert 0 < done < 100000 and not (folder / "evaluation.json").exists()
    args = learning.Args(algorithm="bptt", env=("cartpole",), seeds=(1,), device="cpu", runs=tmp_path, output=tmp_path)
    args.arguments = (*flags, str(done + 30))
    learning.main(args)
    assert [int(row["iteration"]) for row in learning.read_csv(folder / "progress.csv")] == list(range(1, done + 31))
    (row,) = args.read("learning")
    assert row["substeps"] == "4" and row["iterations"] == str(done + 30) and float(row["return"]) < 0
    assert runner.evaluation(folder / "explicit_16")["settings"]["substeps"] == 16

"""The benchmark of learning: what it reads off the curves, and that an interrupted call goes on."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
from pathlib import Path

import learning
import numpy as np
import pytest


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
        (folder / "evaluation.json").write_text(
            json.dumps(dict(substeps=16, finer_substeps=64, own=returns[-1] + 100, finer=returns[-1]))
        )
    learning.write_csv(folder / "progress.csv", rows)


def test_page_compares_steps_and_seconds(tmp_path: Path) -> None:
    """SHAC passes 5,000 at iteration 501, PPO at 2,501 of ten times the steps; BPTT never, and has not finished."""
    runs, docs = tmp_path / "runs", tmp_path / "docs"
    for seed in (1, 2):
        write_run(runs / "shac" / f"ant__{seed}", np.arange(0, 7000, 10.0), 2048, 0.5)
        write_run(runs / "ppo_baseline" / f"ant__{seed}", np.arange(0, 6000, 2.0), 20480, 0.05)
    write_run(runs / "bptt" / "ant__1", np.arange(300.0), 4096, 0.5, finished=False)
    learning.main(learning.Args(experiment="comparison", env=("ant",), runs=runs, docs=docs, draw_only=True))
    rows = {row["learner"]: row for row in learning.table(learning.Args(docs=docs), learning.EXPERIMENTS["comparison"])}
    assert list(rows) == ["shac", "ppo_baseline", "bptt"]
    ratio = "times shac's steps / s"
    assert rows["shac"]["after s"] == "250" and rows["shac"][ratio] == "1 / 1"
    assert float(rows["ppo_baseline"]["after control steps"]) == pytest.approx(2501 * 20480, rel=1e-2)
    steps, seconds = map(float, rows["ppo_baseline"][ratio].split(" / "))
    assert steps == pytest.approx(2501 * 10 / 501, rel=1e-2) and seconds == pytest.approx(0.1 * 2501 / 501, rel=1e-2)
    assert rows["bptt"][ratio] == "never" and rows["bptt"]["final policy, deterministic"] == ""
    assert rows["ppo_baseline"]["best return of training"] == "5998 ± 0" and rows["ppo_baseline"]["published"] == 6605
    assert "| ppo_baseline | 2 | 5998 ± 0 |" in (docs / "experiments.md").read_text()
    for name in ("comparison.png", "comparison_full.png", "results/bptt_ant.csv", "results/ppo_baseline.md"):
        assert (docs / name).stat().st_size > 0
    assert not (docs / "results" / "bptt.md").exists()  # a summary is of finished runs


def test_only_its_own_part_of_a_page_is_filled(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- a -->\nold\n<!-- /a -->\nbetween\n<!-- b -->\n<!-- /b -->\nafter\n")
    for name, text in (("a", "new\n"), ("b", "b\n"), ("a", "newer\n"), ("c", "c\n")):
        learning.fill(page, name, text)
    parts = "before\n<!-- a -->\nnewer\n<!-- /a -->\nbetween\n<!-- b -->\nb\n<!-- /b -->\nafter\n"
    assert page.read_text() == parts + "<!-- c -->\nc\n<!-- /c -->\n"


def test_a_stopped_call_goes_on_where_it_was(tmp_path: Path) -> None:
    args = learning.Args(algorithm="bptt", env=("cartpole",), seeds=(1,), device="cpu", runs=tmp_path, docs=tmp_path)
    learner = "--num-envs", "2", "--horizon", "8", "--eval-every", "0", "--eval-episodes", "1", "--iterations"
    with contextlib.suppress(SystemExit):  # where not one episode was finished in time
        learning.main(dataclasses.replace(args, time_limit=12, arguments=(*learner, "100000")))
    folder = tmp_path / "bptt" / "cartpole__1"
    with (folder / "progress.csv").open() as file:
        done = len(list(csv.DictReader(file)))
    assert 0 < done < 100000 and not (folder / "evaluation.json").exists()
    learning.main(dataclasses.replace(args, arguments=(*learner, str(done + 30))))
    with (folder / "progress.csv").open() as file:
        assert [int(row["iteration"]) for row in csv.DictReader(file)] == list(range(1, done + 31))
    evaluation = json.loads((folder / "evaluation.json").read_text())
    assert evaluation["substeps"] == 4 and evaluation["finer_substeps"] == 16 and evaluation["own"] < 0
    assert len(learning.read_csv(tmp_path / "results" / "bptt_summary.csv")) == 1

"""benchmarks/suites.py: its runs, and what it reads off them."""

from __future__ import annotations

import csv
from pathlib import Path

import mbpo
import pfpn_sac
import pytest
import sac_baseline
import sapo
import suites
from common import RESULTS, ROOT
from guided_policy_search import VariantArgs
from tables import read_csv

import pfpn
import ppo_baseline
import rpo
import shac
from diffsim.training import parse

SCRIPTS = {
    "benchmarks/guided_policy_search": VariantArgs,
    "mbpo": mbpo.Args,
    "pfpn": pfpn.Args,
    "pfpn_sac": pfpn_sac.Args,
    "ppo_baseline": ppo_baseline.Args,
    "rpo": rpo.Args,
    "sac_baseline": sac_baseline.Args,
    "shac": shac.Args,
    "sapo": sapo.Args,
}


@pytest.mark.parametrize("group", suites.GROUPS)
def test_each_run_of_the_page_is_a_command(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    suite, runs = suites.SUITES[suites.GROUPS[group]], list(suites.cases(suites.Args(), group))
    for case in {case.flags: case for _, case in runs}.values():  # seeds share them
        args = parse(SCRIPTS[case.script.partition("@")[0]], ["--env", case.env, "--device", "cpu", *case.flags])
        assert args.iterations > 1
    every = read_csv(RESULTS / suite.machine / f"{suite.csv}.csv")
    rows = [row for row in every if row["group"] == group]
    assert {(row["cell"], int(row["seed"])) for row in rows} <= {(cell, case.seed) for cell, case in runs}
    assert rows
    some = suites.Args(cells=(runs[-1][0],), seeds=(7,))
    assert {(cell, case.seed) for cell, case in suites.cases(some, group)} == {(runs[-1][0], 7)}


def test_a_foot_counts_that_carries_half_as_long_as_another(tmp_path: Path) -> None:
    lines = "left,duty,0.4", "left,slip (m/s),9", "right,duty,0.2", "hand,duty,0.19", "robot,left-right,0.9"
    (tmp_path / "gait.csv").write_text("\n".join(("part,number,value", *lines)))
    assert suites.feet(tmp_path) == 2


def write(folder: Path, returns: list[float], dead: float | None) -> None:
    folder.mkdir(parents=True)
    (folder / "args.json").write_text('{"horizon": 32}')
    rows = []
    for k, value in enumerate(returns, start=1):
        row = {"iteration": k, "control_steps": 1000.0 * k, "return": "" if k == 1 else value, "eval_return": ""}
        if dead is not None:
            row |= {"particles_dead_mean": dead if k == 2 else 0, "particles_dead_max": 0, "particles_moved": 10.0 * k}
        rows.append(row)
    rows[-1]["eval_return"] = 2 * returns[-1] if returns[-1] else ""
    with (folder / "progress.csv").open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_a_cell_is_a_line_over_its_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was stopped before an evaluation is none; a finished one is not trained again."""
    groups, trained = {"one": [(["a", "b", "c"], [1, 2], "pfpn ant")]}, list[Path]()
    suite = suites.SUITES["pfpn"]._replace(cells={"a": "", "b": "--policy gaussian", "c": ""}, groups=groups)
    suite.columns["T"] = ("args", "horizon")
    monkeypatch.setattr(suites, "SUITES", {"some": suite})
    monkeypatch.setattr(suites, "GROUPS", {"one": "some"})
    monkeypatch.setattr("cells.Runner.train", lambda _, case: trained.append(case.folder))
    for number, last in ((1, 100.0), (2, 120.0)):
        write(tmp_path / "some" / f"one__a__{number}", [0.0, 50.0, last], 0.25)
    write(tmp_path / "some" / "one__b__1", [0.0, 10.0, 30.0], None)
    write(tmp_path / "some" / "one__b__2", [0.0, 10.0, 0.0], None)
    suites.main(suites.Args(runs=tmp_path, output=tmp_path / "out", only=("one",)))
    assert len(trained) == 6
    rows = read_csv(tmp_path / "out" / "pfpn_cells.csv")
    assert [(row["cell"], row["seed"], row["T"]) for row in rows] == [
        ("a", "1", "32"),
        ("a", "2", "32"),
        ("b", "1", "32"),
    ]
    assert [(row["eval_return"], row["dead_by_mean"], row["moved"]) for row in rows] == [
        ("200", "0.25", "30"),
        ("240", "0.25", "30"),
        ("60", "", ""),
    ]

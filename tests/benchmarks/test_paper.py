"""The list of cells: which are missing, which are printed, and that none is of two revisions."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import common
import fingerprints
import paper
import pytest
import tables
from cells import Runner
from learners import refusal

LINK = dict(revision="HEAD", parent="HEAD", equal=" ".join(fingerprints.CASES), differ="", reason="")
SAPO = dict(learner="sapo", task="hopper", revision="aaaaaaa", iterations="1100", falls="0", kept="0.99", speed="4")


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, str]]:
    """The lines of the H200's cells.csv; the code is that of aaaaaaa."""
    rows = list[dict[str, str]]()
    monkeypatch.setattr("cells.read_csv", lambda path: rows if path.parts[-2:] == ("h200", "cells.csv") else [])
    monkeypatch.setattr(fingerprints, "open_end", str)
    monkeypatch.setattr("cells.same_numbers", lambda revision, learner, task: revision == "aaaaaaa")
    for seed, value in enumerate((5000.0, 5100.0, 4800.0, 5300.0, 5200.0), start=1):
        row = SAPO | {"seed": str(seed), "return": f"{value}", "training (s)": f"{60 + seed}", "falls": f"{seed / 100}"}
        row["trained on"] = "NVIDIA H200"
        rows.append(row | {"seconds to 3000": "inf" if seed < 3 else "9", "control_steps to 3000": f"{seed}e6"})
    return rows


def history() -> bool:
    """Whether the revisions of the chain are here."""
    first = fingerprints.links()[0]["parent"]
    return fingerprints.same_files(first, first)


def test_every_cell_is_there_once_the_first_seeds_first() -> None:
    found = list(paper.wanted(paper.Args()))
    assert len(found) == len({*found}) and [cell.seed for cell in found] == sorted(cell.seed for cell in found)
    for group in (group for group in paper.GROUPS.values() if not group.older):
        assert group.machine in ("cpu", "h200") and group.seeds >= 3
        for learner in group.learners:
            assert paper.Cell(group.machine, learner, group.tasks[-1], group.seeds) in found
    (one,) = paper.wanted(paper.Args(only=("headline",), learners=("sapo",), env=("hopper",), seeds=(4,)))
    assert one == paper.Cell("h200", "sapo", "hopper", 4) and one.timed
    assert not paper.Cell("cpu", "shac_fast", "cartpole", 1).timed and paper.Cell("cpu", "shac", "cartpole", 1).timed
    some = list(paper.wanted(paper.Args(only=("headline", "large_batch"), env=("humanoid",), seeds=(2, 4))))
    assert {(cell.learner, cell.seed) for cell in some} == {
        *((learner, seed) for learner in ("rpo", "shac", "sapo", "ppo_4096") for seed in (2, 4)),
        ("sac_large", 2),
    }
    (cell,) = (cell for cell in some if cell.learner == "sac_large")
    command = "python baselines/sac_baseline.py --env humanoid --seed 2 --device cuda --large-batch --accuracy fast"
    assert cell.command == f"{command} --iterations 400"
    other = paper.Args(only=("headline", "cores"), learners=("sapo",), env=("hopper",), seeds=(4,), machine="h100")
    assert [*paper.wanted(other)] == [one._replace(machine="h100"), one._replace(machine="cpu")]
    assert one._replace(machine="h100").timed


def test_a_line_has_all_seeds_of_one_revision(known: list[dict[str, str]]) -> None:
    (line,) = paper.table(paper.Args(), "headline")
    assert (line["task"], line["learner"]) == ("hopper", "sapo")
    assert line["return"] == "5100 (4800 to 5300)" and line["training (s)"] == "63" and line["falls"] == "0.05"
    assert (line["s to target"], line["M steps to target"], line["seed 1 in all (s)"]) == ("9 (9 to never)", "3", "")
    for column, other in {"revision": "bbbbbbb", "trained on": "NVIDIA H100", "training (s)": ""}.items():
        before, known[4][column] = known[4][column], other
        assert paper.table(paper.Args(), "headline") == []
        known[4][column] = before
    known[4]["seed"] = "6"
    assert paper.table(paper.Args(), "headline") == []


def test_a_line_has_the_total_of_seed_1_of_its_machine(known: list[dict[str, str]], tmp_path: Path) -> None:
    args, total = paper.Args(output=tmp_path / "cpu"), known[0] | {"in all (s)": "77.6"}
    for machine, other, shown in (
        ("h100", {}, ""),
        ("cpu", {}, ""),
        ("h200", {"seed": "2"}, ""),
        ("h200", {"revision": "bbbbbbb"}, ""),
        ("h200", {"task": "ant"}, ""),
        ("h200", {}, "78"),
    ):
        path = tmp_path / machine / "cells.csv"
        tables.replace_csv(path, [total | other], paper.KEY, "cpu")
        (line,) = paper.table(args, "headline")
        assert line["seed 1 in all (s)"] == shown and line["training (s)"] == "63"
        path.unlink()


def test_a_cell_that_shared_its_gpu_has_the_seconds_of_the_pace(
    known: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    pace = {"learner": "sapo", "task": "hopper", "revision": "aaaaaaa", "start (s)": "1.5", "iteration (s)": "0.05"}
    shared = {"training (s)": "", "seconds to 3000": "", "control steps": "33e6", "control_steps to 3000": "6e6"}
    known[3] |= shared
    known[4] |= shared | {"control_steps to 3000": "inf"}
    files = {"cells.csv": known, "pace.csv": [pace]}
    monkeypatch.setattr("cells.read_csv", lambda path: files[path.name] if path.parts[-2] == "h200" else [])
    rows = paper.read_cells(Path("h200"))
    assert [float(row["training (s)"]) for row in rows] == pytest.approx([61, 62, 63, 56.5, 56.5])
    assert [float(row["seconds to 3000"]) for row in rows] == pytest.approx([math.inf, math.inf, 9, 11.5, math.inf])
    for other in ({"task": "ant"}, {"revision": "bbbbbbb"}):
        known[3] |= shared
        pace |= other
        assert paper.read_cells(Path("h200"))[3]["training (s)"] == ""
        assert paper.table(paper.Args(), "headline") == []


def test_pages_show_the_lines_of_the_cells() -> None:
    if not history():
        pytest.skip("the history is not here")
    args, shown = paper.Args(output=common.RESULTS / "cpu"), 0
    for name, group in paper.GROUPS.items():
        if not group.page:
            continue
        (part,) = re.findall(
            rf"<!-- {name} -->\n(.*?)<!-- /{name} -->", (common.DOCS / group.page).read_text(), re.DOTALL
        )
        if "|" in (expected := paper.printed(args, name)) or not group.older:
            assert part == expected
        shown += len(paper.table(args, name))
    assert shown


def test_a_curve_has_some_points_and_the_seconds_of_a_run_that_was_alone(tmp_path: Path) -> None:
    for machine, learner, shared in (("h200", "shac", False), ("h200", "shac", True), ("cpu", "shac_no_critic", False)):
        args, cell = paper.Args(runs=tmp_path, shared=shared), paper.Cell(machine, learner, "ant", 2)
        folder = cell.case(tmp_path).folder
        folder.mkdir(parents=True, exist_ok=True)
        lines = [f"{k},{2048 * k},{k / 2},{200 * k if k > 3 else ''}" for k in range(1, 400)]
        (folder / "progress.csv").write_text("\n".join(["iteration,control_steps,seconds,return", *lines]))
        chosen = paper.points(args, cell)
        assert len(chosen) == paper.POINTS and (chosen[0]["iteration"], chosen[-1]["iteration"]) == ("4", "399")
        assert all(row["return"] == f"{200 * int(str(row['iteration']))}" for row in chosen)
        assert ("seconds" in chosen[0]) == (machine == "h200" and not shared)  # of a group with seconds


def test_what_is_missing_is_said_with_its_command(known: list[dict[str, str]]) -> None:
    known[2]["revision"] = "bbbbbbb"
    args = paper.Args(only=("headline",), env=("hopper",))
    *lines, count = paper.check(args).splitlines()
    assert lines == [
        "h200: python rpo.py --env hopper --seed {1 2 3 4 5} --device cuda",
        "h200: python shac.py --env hopper --seed {1 2 3 4 5} --device cuda",
        "h200: python ppo_baseline.py --env hopper --seed {1 2 3 4 5} --device cuda "
        "--num-envs 4096 --minibatch-size 32768 --entropy-coef 0.002 --iterations 1200",
        "h200: python baselines/sapo.py --env hopper --seed {3} --device cuda",
    ]
    assert count == "16 of 20 cells are missing"


def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    error = refusal(lambda: paper.main(paper.Args(only=("headlines",))), capsys)
    assert "--only: there is no 'headlines'; choose from headline, steps_ant" in error
    error = refusal(lambda: paper.main(paper.Args(learners=("SHAC",))), capsys)
    assert "--learners: there is no 'SHAC'; choose from shac, shac_no_critic" in error
    monkeypatch.setattr(tables, "revision", lambda: "1234567-dirty")
    cell = paper.Cell("cpu", "shac", "cartpole", 1)

    def begin() -> None:
        paper.cells.train(Runner(paper.Args(runs=Path("nowhere"))), cell)

    assert refusal(begin, capsys).endswith("a cell is of a commit, not of 1234567-dirty")
    monkeypatch.setattr(tables, "revision", lambda: "1234567")
    monkeypatch.setattr(fingerprints, "links", list)
    assert "python benchmarks/paper.py --same REVISION" in refusal(begin, capsys)


def test_cells_are_trained_evaluated_and_kept_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tables, "revision", lambda: "HEAD")
    monkeypatch.setattr(fingerprints, "links", lambda: [LINK])
    places = ["--runs", str(tmp_path / "runs"), "--output", str(tmp_path / "results" / "cpu"), "--device", "cpu"]
    flags = [*places, "--only", "cores", "--env", "cartpole", "--seeds", "1"]
    short = "-- --iterations 2 --num-envs 4 --horizon 4 --eval-episodes 2".split()

    def call(*more: str) -> list[dict[str, str]]:
        args = common.parse(paper.Args, None, [*flags, *more, *short])
        paper.main(args)
        return args.read("cells")

    assert call("--train-only") == []
    assert {row["learner"]: row["iterations"] for row in call("--evaluate-only")} == {"shac": "2", "sapo": "2"}
    call("--pace", "2")
    for pace in tables.read_csv(tmp_path / "results" / "cpu" / "pace.csv"):
        assert pace["iterations"] == "2" and pace["trained on"] and float(pace["iteration (s)"]) > 0
    folder = tmp_path / "runs" / "cpu" / "shac" / "cartpole__1"
    before = (folder / "checkpoint.pt").stat().st_mtime_ns
    row: dict[str, Any] = next(row for row in call() if row["learner"] == "shac")
    assert (folder / "checkpoint.pt").stat().st_mtime_ns == before and len(call()) == 2
    assert row["revision"] == "HEAD" and float(row["in all (s)"]) > float(row["training (s)"]) > 0
    assert float(row["return"]) < 0 and float(row["kept"]) > 0.9 and row["seconds to -1000"] == "inf"

    (tmp_path / "results" / "cpu" / "cells.csv").unlink()
    (folder / "cell.json").write_text(json.dumps({"revision": "no-commit", "trained on": ""}))
    assert "was begun at no-commit" in refusal(call, capsys)

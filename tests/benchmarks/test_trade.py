"""benchmarks/trade.py: its trainings, what a row says of one, and which settings are on the front."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import trade
from cells import Runner
from test_suites import SCRIPTS

from diffsim.training import parse


def row(setting: str, seed: int, seconds: float | str, finer: float, part: str = "accuracy") -> dict[str, str]:
    cells = {
        "part": part,
        "task": "ant",
        "setting": setting,
        "seed": seed,
        "core seconds": seconds,
        "return": finer + 1,
    }
    cells |= {
        "return, finer": finer,
        "return in MuJoCo": "",
        "whole in MuJoCo": "",
        "skipped": 0,
        "contained": 0,
        "failed": "",
    }
    return {name: str(value) for name, value in cells.items()}


def test_each_training_is_a_command_with_a_folder_of_its_own() -> None:
    every = [case for _, case in trade.cases(trade.Args())]
    assert len({case.folder for case in every}) == len(every)
    assert [case.seed for case in every] == sorted(case.seed for case in every)  # each seed of all before the next
    for case in (case for case in every if case.seed == 1):
        args = parse(SCRIPTS[case.script], ["--env", case.env, "--device", "cpu", *case.flags])
        assert args.threads == 1 and args.eval_every == 0
    horizons = [["--env", "ant", *flags.split()] for flags in trade.PARTS["horizon"].settings.values()]
    sizes = [parse(SCRIPTS["rpo"], flags) for flags in horizons]
    assert {args.num_envs * args.horizon * args.iterations for args in sizes} == {2048 * 200}


def test_the_front_has_what_nothing_faster_is_as_good_as() -> None:
    points = {"fast": (10.0, 100.0), "slow, worse": (20.0, 90.0), "as good": (30.0, 100.9), "best": (40.0, 110.0)}
    points["hardly slower, worse"] = (11.0, 90.0)
    assert trade.front(points) == {"fast", "best", "hardly slower, worse"}
    costs = {name: (x, -1e4 / y) for name, (x, y) in points.items()}
    assert trade.front(costs) == {"fast", "best", "hardly slower, worse"}


def test_a_line_has_medians_and_the_front_is_bold() -> None:
    rows = [row("fast", seed, 10 + seed, value) for seed, value in ((1, 70), (2, 90), (3, 80))]
    rows += [row("default", 1, 20, 79), row("accurate", 1, 60, 81)]
    lines = trade.traded(rows)
    assert lines[0] == {
        **{"task": "ant", "setting": "**fast**", "core seconds": "12", "return": "81", "at 4 x the substeps": "80"}
    }
    assert [line["setting"] for line in lines[1:]] == ["default", "**accurate**"]
    (line,) = trade.traded([row("fast", 1, "", 70)])  # of a GPU that others used too
    assert line == {"task": "ant", "setting": "fast", "return": "71", "at 4 x the substeps": "70"}


def test_errors_are_those_of_the_training_s_own_integration() -> None:
    lines = trade.learned(
        [
            row("default", 1, 9, 80),
            row("2", 1, 5, 40, "substeps"),
            row("1", 1, 5, 90, "substeps"),
            row("shac, fast", 1, 1, 1),
        ]
    )
    assert [line["substeps"] for line in lines] == ["2", "8 implicit"]  # rpo's ant; the errors with 1 have no numbers
    assert [line["share of the best return"] for line in lines] == ["0.50", "1.00"]
    assert [line["gradient error"] for line in lines] == ["59.1", "0.299"]


def test_an_extreme_is_a_line_with_what_was_skipped_and_contained() -> None:
    rows = [row("1", 1, 5, 40, "substeps") | {"skipped": "7", "contained": "9"}]
    (line,) = trade.extreme(rows)
    assert line == {
        **{"task": "ant", "substeps": "1", "core seconds": "5", "return": "41", "at 4 x the substeps": "40"},
        **{"updates skipped": "7", "contained": "9"},
    }
    failed = {"core seconds": "", "return": "", "return, finer": "", "skipped": "", "contained": "", "failed": "no"}
    assert [line["failed"] for line in trade.extreme([*rows, rows[0] | failed])] == ["", "no"]


def test_costs_are_shares_of_the_best_too() -> None:
    rows = [row("default", 1, 9, -100), row("fast", 1, 5, -200)]
    lines = trade.learned([each | {"task": "cartpole"} for each in rows])
    assert {line["substeps"]: line["share of the best return"] for line in lines} == {"4": "1.00", "1 implicit": "0.50"}


def test_a_training_that_fails_is_a_row_with_its_message(tmp_path: Path) -> None:
    args = trade.Args(env=("cartpole",), parts=("accuracy",), settings=("fast",), seeds=(1,), runs=tmp_path)
    args.arguments = ("--num-envs", "2", "--horizon", "4", "--iterations", "2", "--actor-lr", "1e38")
    _, case = next(iter(trade.cases(args)))
    found = trade.measure(Runner(args), case)
    assert found == {"failed": found["failed"]} and "action is NaN" in str(found["failed"])
    late = trade.Args(runs=tmp_path / "none", time_limit=0)
    assert trade.measure(Runner(late), case._replace(folder=tmp_path / "none")) == {}


def test_a_row_has_seconds_of_the_training_alone_and_returns_of_many_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trade, "EPISODES", 2)
    args = trade.Args(env=("cartpole",), parts=("accuracy",), settings=("default",), seeds=(1,), runs=tmp_path)
    args.arguments = ("--num-envs", "2", "--horizon", "4", "--iterations", "2")
    _, case = next(iter(trade.cases(args)))
    found = trade.measure(Runner(args), case)
    again = trade.measure(Runner(args), case)
    assert found == again  # nothing is trained or evaluated twice
    assert found["core seconds"] == float((case.folder / "core_seconds.txt").read_text())
    assert found["control steps"] == 16 and found["substeps"] == 4 and found["failed"] == ""
    assert (found["skipped"], found["contained"]) == (0, 0)
    assert found["return"] < 0 > found["return, finer"] and math.isfinite(found["return in MuJoCo"])
    assert found["whole in MuJoCo"] == 1.0

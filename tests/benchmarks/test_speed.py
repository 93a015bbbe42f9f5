"""What the benchmark of speed makes of times, and lines of a picture."""

from __future__ import annotations

from pathlib import Path

import pytest
import speed
import torch
from common import Panel, lines

from diffsim.training.errors import UsageError


def test_of_each_state_the_fastest_turn_counts_and_over_states_the_median() -> None:
    times = iter([99.0, 3.0, 1.0, 7.0, 5.0, 20.0, 30.0])  # the first state warms up; two turns in each of three
    state = (torch.zeros(1),) * 3
    found = speed.race({"ours": lambda _: {"forward": next(times)}}, [state] * 4, repeats=2)
    assert found == {"ours": {"forward": 5.0}}


def test_a_trial_knows_its_first_iteration_and_the_most_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = """import json, pathlib, sys, time
if sys.argv[-1] == "fail":
    raise SystemExit(3)
held = b"x" * (300 << 20)
del held
run = pathlib.Path(sys.argv[sys.argv.index("--run-dir") + 1])
(run / "args.json").write_text(json.dumps({"num_envs": 64}))
(run / "progress.csv").write_text("iteration\\n1\\n")
time.sleep(0.5)"""
    (tmp_path / "shac.py").write_text(code)
    monkeypatch.setattr(speed, "ROOT", tmp_path)
    found = speed.trial(args := speed.Args(), "ant", 3)
    assert found.about == {"task": "ant", "environments": 64, "script": "shac"} and found.progress == [
        {"iteration": "1"}
    ]
    assert 0.3 < found.memory < 0.4 and 0 < found.first < 5
    with pytest.raises(UsageError, match="shac.py.* fail failed"):
        speed.trial(args, "ant", 3, "fail")


def test_a_line_for_each_value_by_its_x() -> None:
    rows = [{"n": "64", "us": "2", "task": "ant"}, {"n": "8", "us": "1", "task": "ant"}]
    first, second = lines([*rows, {"n": "8", "us": "3", "task": "hopper"}], "n", "us", "task")
    assert (first.label, [*first.x], [*first.y]) == ("ant", [8.0, 64.0], [1.0, 2.0])
    assert (second.label, second.style) == ("hopper", "C1o-") and Panel([first, second]).log == ""

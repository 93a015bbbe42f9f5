"""What the benchmark of speed makes of times, and lines of a picture."""

from __future__ import annotations

import speed
import torch
from common import Panel, lines


def test_of_each_state_the_fastest_turn_counts_and_over_states_the_median() -> None:
    times = iter([99.0, 3.0, 1.0, 7.0, 5.0, 20.0, 30.0])  # the first state warms up; two turns in each of three
    state = (torch.zeros(1),) * 3
    found = speed.race({"ours": lambda _: {"forward": next(times)}}, [state] * 4, repeats=2)
    assert found == {"ours": {"forward": 5.0}}


def test_a_line_for_each_value_by_its_x() -> None:
    rows = [{"n": "64", "us": "2", "task": "ant"}, {"n": "8", "us": "1", "task": "ant"}]
    first, second = lines([*rows, {"n": "8", "us": "3", "task": "hopper"}], "n", "us", "task")
    assert (first.label, [*first.x], [*first.y]) == ("ant", [8.0, 64.0], [1.0, 2.0])
    assert (second.label, second.style) == ("hopper", "C1o-") and Panel([first, second]).log == ""

"""docs/numerics.md: presets lie on their front, and more substeps cost more."""

from __future__ import annotations

import numerics
from common import RESULTS
from tables import Cells, grouped, read_csv

import diffsim

ERRORS = ("state 0.5 s", "gradient 8", "gradient 32")
SETTINGS = read_csv(RESULTS / "cpu" / "numerics_presets.csv")


MEASURED = {name: task for name, task in diffsim.TASKS.items() if name != "g1_track"}  # which moves g1's robot


def test_every_task_is_driven_to_extremes() -> None:
    assert {row["task"] for row in read_csv(RESULTS / "cpu" / "numerics_extremes.csv")} == {*MEASURED}


def test_every_task_has_been_measured_with_all_its_presets() -> None:
    found = {(row["task"], row["preset"]) for row in numerics.presets(SETTINGS)}
    assert found == {(name, preset) for name, task in MEASURED.items() for preset in task.presets()}


def test_no_setting_that_is_as_fast_beats_a_preset_in_all_errors() -> None:
    """By a tenth: medians over 32 states have no more digits."""
    for _, own in grouped(numerics.labelled(SETTINGS), "task").items():
        for preset in (row for row in own if row["preset"]):
            cost, errors = float(preset["us with gradient"]), [float(preset[name]) for name in ERRORS]
            for other in own:
                worse = [float(other[name]) > 0.9 * error for name, error in zip(ERRORS, errors, strict=True)]
                assert other is preset or float(other["us with gradient"]) > cost or any(worse), (preset, other)


def test_accurate_is_more_accurate_and_fast_is_faster() -> None:
    for _, own in grouped(numerics.presets(SETTINGS), "task").items():
        by = {row["preset"]: row for row in own}
        for name in ERRORS if "accurate" in by else ():
            assert float(by["accurate"][name]) < float(by["default"][name]), by
        assert "fast" not in by or float(by["fast"]["speed"]) >= 1.1, by


def test_more_substeps_never_cost_less() -> None:
    for _, own in grouped(SETTINGS, "task", "kind").items():
        costs = [float(row["us with gradient"]) for row in sorted(own, key=substeps)]
        assert all(a <= 1.03 * b for a, b in zip(costs, costs[1:], strict=False)), own  # timings differ by that


def substeps(row: Cells) -> int:
    return int(row["setting"].split()[-2])


def test_a_bound_is_the_mildest_value_that_fails() -> None:
    rows = [
        {"task": "ant", "sweep": "substeps", "implicit 0": "3 (energy)", "mujoco": ""},
        {"task": "hopper", "sweep": "substeps", "implicit 0": "6 (not finite)", "mujoco": ""},
        {"task": "go2", "sweep": "substeps", "implicit 0": "", "mujoco": "-"},
        {"task": "ant", "sweep": "drop (m)", "implicit 0": "100 (energy)", "mujoco": ""},
        {"task": "hopper", "sweep": "drop (m)", "implicit 0": "10 (energy)", "mujoco": ""},
    ]
    assert numerics.bounds(rows) == [
        {"sweep": "substeps", "implicit 0": "6 (2/2)", "mujoco": "-"},
        {"sweep": "drop (m)", "implicit 0": "10 (2/2)", "mujoco": "-"},
    ]


def test_the_promise_is_kept() -> None:
    rows = read_csv(RESULTS / "cpu" / "numerics_promise.csv")
    assert {row["robot"] for row in rows} == {"go2", "g1", "hopper", "own_robot", "walker", "humanoid_CMU"}
    assert all(float(row["times 0.01"]) <= 1.5 for row in rows)

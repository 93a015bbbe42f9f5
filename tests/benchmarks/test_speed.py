"""What the benchmarks of the simulator make of times, errors and energies."""

from __future__ import annotations

from pathlib import Path

import pytest
import speed
import stability
import torch
import tradeoff
from common import DOCS, RESULTS, Panel, lines, measured, parse
from tables import markdown, read_csv

import diffsim
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


def test_the_front_is_what_no_other_point_beats() -> None:
    assert tradeoff.front([(3, 1), (1, 3), (2, 2), (3, 2), (2, 4)]) == [(1, 3), (2, 2), (3, 1)]


def test_a_line_for_each_value_by_its_x() -> None:
    rows = [{"n": "64", "us": "2", "task": "ant"}, {"n": "8", "us": "1", "task": "ant"}]
    first, second = lines([*rows, {"n": "8", "us": "3", "task": "hopper"}], "n", "us", "task")
    assert (first.label, [*first.x], [*first.y]) == ("ant", [8.0, 64.0], [1.0, 2.0])
    assert (second.label, second.style) == ("hopper", "C1o-") and Panel([first, second]).log == ""


@pytest.mark.parametrize(("faster", "bounded"), [(1.0, True), (1.2, False)])
def test_energy_along_a_fall(faster: float, bounded: bool) -> None:
    """A hopper falls from 2 m; at the end it may be faster than it should."""
    env = diffsim.make("hopper", 1, dtype=torch.float64)
    t = torch.linspace(0, 0.5, 20).double()
    qpos, qvel = env.qpos.repeat(20, 1, 1), torch.zeros(20, 1, env.scene.nv).double()
    qpos[:, 0, 1] += 2 - 9.81 / 2 * t**2
    qvel[:, 0, 1] = -9.81 * t
    qvel[-1] *= faster
    assert stability.bounded(env.scene, env.scene.mj_model, qpos, qvel) == bounded
    scene = diffsim.make("cartpole", 1).scene  # which has no ground
    assert (stability.stored(scene, torch.zeros(2, scene.nq)) == 0).all()


def test_a_sweep_s_line_names_the_first_value_that_fails() -> None:
    cells = {"task": "ant", "sweep": "speed (m/s)", "integrator": "semi_implicit"}
    rows = [
        cells | {"value": value, "finite": finite, "energy bounded": energy}
        for value, finite, energy in (("1", "True", "True"), ("10", "True", "False"), ("100", "False", "False"))
    ]
    (line,) = stability.summary([*rows, rows[0] | {"sweep": "action"}])  # which nothing fails
    assert line["sweep"] == "speed (m/s)" and [*line.values()][2:] == ["10 (energy)", "-", "-", "-"]


def test_the_pages_have_the_tables_of_the_csv_files(capsys: pytest.CaptureFixture[str]) -> None:
    for part in ("step", "sweeps", "energy"):
        measured(stability.Args(draw_only=True, output=RESULTS / "cpu"), stability.PARTS[part])
        assert capsys.readouterr().out.removesuffix("\n") in (DOCS / "stability.md").read_text()
    presets = tradeoff.presets(read_csv(RESULTS / "cpu" / "tradeoff.csv"))
    assert markdown(presets) in (DOCS / "accuracy.md").read_text()


def test_the_command_counts_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--env", "cartpole", "--parts", "long", "--steps", "15424", "--output", str(tmp_path)]
    stability.main(parse(stability.Args, None, flags))
    (row,) = read_csv(tmp_path / "stability_long.csv")
    assert row["control steps"] == "15424" and row["contained"] == "0" and row["episodes"] == "64"
    assert f"| cartpole | 15424 | 0 | {row['largest velocity']} | 64 |" in capsys.readouterr().out

"""Transfer, gradients of contact, robots of others, and speed: what is measured, on small cases."""

from __future__ import annotations

from pathlib import Path

import foreign
import gradients
import numpy as np
import pytest
import speed
import torch
import transfer
from common import Panel, lines, parse
from scenes import BOUNDED_SERVOS, pendulum, robot
from tables import ROOT, markdown, read_csv

import diffsim
from diffsim.training.checkpoint import POLICIES

# Transfer -------------------------------------------------------------------------------------------------------------


def test_the_summary_of_a_known_motion() -> None:
    """A hopper glides along; the second episode ends after half of it."""
    env = diffsim.make("hopper", 2)
    qpos, qvel = np.zeros((61, 2, 6)), np.zeros((61, 2, 6))
    qpos[..., 0] = 1.5 * env.control_dt * np.arange(61)[:, None]
    motion = transfer.Motion(qpos, qvel, np.array([3.0, 1.0]), np.array([60, 30]), np.array([False, True]))
    assert transfer.summary(motion, env) == pytest.approx({"return": 2.0, "speed": 1.5, "whole": 0.5})


def test_a_row_for_each_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is kept counts from the world of the training, here or, in mujoco_warp, that of the same law."""
    state = torch.load(POLICIES / "hopper.pt", weights_only=True)
    exact = {"contact": "mujoco", "substeps": 4, "seed": 1}
    paths = [POLICIES / "hopper.pt", POLICIES / "cartpole.pt"]
    for simulator in ("diffsim", "mujoco_warp"):
        paths.append(tmp_path / simulator / "hopper__1" / "checkpoint.pt")
        paths[-1].parent.mkdir(parents=True)
        torch.save(state | {"args": state["args"] | exact, "simulator": simulator}, paths[-1])
    flags = "--episodes 2 --steps 30 --friction 1 0.5 --output".split()
    transfer.main(parse(transfer.Args, None, [*map(str, paths), *flags, str(tmp_path)]))
    rows = read_csv(tmp_path / "transfer.csv")
    by = {line["learner"]: line for line in transfer.table(rows)}
    assert markdown(transfer.table(rows)) in capsys.readouterr().out
    worlds = ["here", "MuJoCo x1", "MuJoCo x0.5"]
    for learner, names, judge in (
        ("policies/hopper", worlds, "MuJoCo x1"),
        ("diffsim", ["here", "MuJoCo same", *worlds[1:]], "MuJoCo x1"),
        ("mujoco_warp", ["MuJoCo same", "here", *worlds[1:]], "here"),
    ):
        own = {row["condition"]: row for row in rows if row["checkpoint"].startswith(learner)}
        speeds = {name: float(row["speed"]) for name, row in own.items()}
        assert sorted(own) == sorted(names)
        kept = float(own[judge]["kept"])
        assert kept == pytest.approx(speeds[judge] / speeds[names[0]], rel=0.01)
        assert by[learner]["retained (worst)"] == f"{kept:.0%} ({kept:.0%})"
        if "MuJoCo same" in own:  # one law
            assert speeds["here"] == pytest.approx(speeds["MuJoCo same"], rel=0.01)
    alone = [row for row in rows if row["task"] == "cartpole"]  # which touches nothing: a return, the same in MuJoCo
    assert [row["condition"] for row in alone] == ["here", "MuJoCo x1"]
    assert all(row["return"] and not row["speed"] for row in alone)
    line = by["policies/cartpole"]
    assert float(line["here"]) == pytest.approx(float(line["MuJoCo x1"]), rel=0.02) and line["retained (worst)"] == ""


# Gradients ------------------------------------------------------------------------------------------------------------


def test_the_gradient_of_a_window_agrees_with_differences() -> None:
    """Where no jump is in reach; both begin in the same state, which differences leave as it was."""
    env = diffsim.make("hopper", 16, horizon=4, dtype=torch.float64, early_termination=False)
    policy = torch.nn.Linear(env.task.obs_dim, env.scene.nu).double()
    torch.nn.init.normal_(policy.weight, std=0.02, generator=torch.Generator().manual_seed(0))
    env.reset(seed=0)
    noise = 0.1 * torch.randn(4, 16, env.scene.nu, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start = env.qpos.clone()
    along = gradients.axes(env.scene.nu, 2).double()  # two random directions of three controls
    torch.testing.assert_close(
        along @ along.T, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-6
    )  # they are of float32
    slopes = gradients.differences(env, policy, noise, along, 1e-5)
    assert torch.equal(env.qpos, start)
    shift = torch.zeros(16, env.scene.nu, dtype=torch.float64, requires_grad=True)
    (each,) = torch.autograd.grad(gradients.rollout(env, policy, 4, shift, noise).sum(), shift)
    torch.testing.assert_close(each @ along.T, slopes, rtol=1e-4, atol=1e-6)


def test_agreement_of_known_vectors() -> None:
    """The gradient is twice as long as the differences; the halves are perpendicular to each other."""
    slopes = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    found = gradients.agreement(2 * slopes, slopes, slopes * torch.tensor([1.0, 0.0]))
    assert found == pytest.approx({"cosine": 1, "differences": 0.5**0.5, "halves": 0, "ratio": 2, "chance": 1})


def test_gradients_on_each_ground(tmp_path: Path) -> None:
    flags = f"--num-envs 16 --horizons 8 --warmup 990 --output {tmp_path}".split()
    gradients.main(parse(gradients.Args, None, [str(POLICIES / "hopper.pt"), *flags]))
    rows = read_csv(tmp_path / "gradients.csv")
    assert [row["ground"] for row in rows] == [*gradients.GROUNDS]
    assert len({row["norm"] for row in rows}) == len(rows)
    assert all(float(row["error"]) < 1e-5 for row in rows)
    assert all(abs(float(row["cosine"])) <= 1 for row in rows) and float(rows[0]["differences"]) > 0.99


def test_a_page_shows_no_cosine_that_chance_decides() -> None:
    row = {"task": "ant", "learner": "noise", "ground": "mujoco", "differences": "0.95", "ratio": "1"}
    rows = [
        row | {"horizon": "4", "cosine": "0.8", "chance": "0.1"},
        row | {"horizon": "8", "cosine": "0.7", "chance": "2"},
    ]
    (line,) = gradients.shown([*rows, rows[0] | {"horizon": "16", "differences": "0.5"}, rows[0] | {"ground": "soft"}])
    empty = "cosine, 8 steps", "cosine, 16 steps", "cosine, 32 steps", "ratio, 8 steps"
    cells = {"cosine, 4 steps": "0.8"} | dict.fromkeys(empty, "")
    assert line == {"task": "ant"} | cells


def test_gradients_without_a_name_are_those_of_all_tasks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [str(path) for path in gradients.Args().measured] == [*diffsim.TASKS]
    flags = f"go2 --num-envs 4 --horizons 1 --warmup 1 --directions 2 --output {tmp_path}".split()
    gradients.main(parse(gradients.Args, None, flags))
    assert [row["ground"] for row in read_csv(tmp_path / "gradients.csv")] == ["mujoco"]
    assert "go2: soft contact has no frictionloss\n" in capsys.readouterr().out


# Robots of others -----------------------------------------------------------------------------------------------------

SHELL = '<asset><mesh name="shell" file="shell.stl"/></asset>'


def test_a_folder_becomes_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a step in contact and one with a rough shape; an absent mesh has a stand-in if it is only drawn."""
    shell = '<geom type="mesh" mesh="shell" contype="0" conaffinity="0" mass="0"/>'
    rock = robot('<body><freejoint/><geom type="cylinder" size=".1 .1"/></body>')
    robots = {
        "servos": BOUNDED_SERVOS,
        "rubbed": pendulum('axis="0 1 0" frictionloss="1"'),
        "ball": robot(f'<body><freejoint/><geom size=".1"/>{shell}</body>', SHELL),
        "rough": rock,
        "bad": pendulum(rest='<actuator><velocity joint="hinge" kv="-2"/></actuator>'),
        "solid": robot(f"<body><freejoint/>{shell.replace('contype', 'group')}</body>", SHELL),
    }
    for name, mjcf in robots.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(mjcf)
    flags = ["--states", "8", "--output", str(tmp_path / "out")]
    foreign.main(parse(foreign.Args, None, [str(tmp_path), *flags]))
    out = capsys.readouterr().out
    assert "6 files: 2 refused, 2 equal with contact, 2 equal without contact" in out
    assert "1 refused, actuator: stiffness and damping of a servo must not be negative (bad)" in out
    rows = {row["file"].partition("/")[0]: row for row in read_csv(tmp_path / "out" / "foreign.csv")}
    bad = "actuator number 0: stiffness and damping of a servo must not be negative"
    assert rows["bad"]["refused"] == bad and rows["solid"]["refused"] == "Error: Error opening file 'shell.stl'"
    for name in ("servos", "rubbed", "ball", "rough"):
        assert rows[name]["refused"] == ""
        assert float(rows[name]["relative error of qacc"]) < 1e-9 and float(rows[name]["step"]) < 1e-9
        assert float(rows[name]["states"]) == foreign.STEPS
    assert rows["ball"]["absent meshes"] == "1" and rows["ball"]["with contact"] == "16"
    assert rows["rough"]["outcome"] == "equal without contact" and 0 < float(rows["rough"]["step of told contacts"]) < 1
    assert "8 of each rim of a cylinder" in rows["rough"]["told"]


def test_no_recorded_difference_is_silent() -> None:
    rows = read_csv(ROOT / "results" / "cpu" / "foreign.csv")
    assert rows and not [row["file"] for row in rows if row["outcome"] == "silent"]
    assert not [row["file"] for row in rows if row["outcome"] == "told" and "Left out" not in row["told"]]


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ({"step": ""}, "loaded"),
        ({"step": 1e-9, "with contact": 3}, "equal with contact"),
        ({"step": 1e-3, "converged": 1e-9}, "equal if converged"),
        ({"step": 1e-3, "converged": 1e-3, "told": "Left out: noslip"}, "told"),
        ({"step": float("nan"), "converged": float("nan"), "told": ""}, "silent"),
    ],
)
def test_a_difference_that_nothing_tells_is_silent(cells: dict[str, object], expected: str) -> None:
    assert foreign.outcome({"refused": ""} | cells) == expected


# Speed ----------------------------------------------------------------------------------------------------------------


def test_of_each_state_the_fastest_turn_counts_and_over_states_the_median() -> None:
    times = iter([99.0, 3.0, 1.0, 7.0, 5.0, 20.0, 30.0])  # the first state warms up; two turns in each of three
    state = (torch.zeros(1),) * 3
    found = speed.race({"ours": lambda _: {"forward": next(times)}}, [state] * 4, repeats=2)
    assert found == {"ours": {"forward": 5.0}}


def test_microseconds_count_for_a_substep_of_one_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    times = {"mj_step": 640.0, "forward": 320.0, "backward": 1280.0}  # of 2 x 16 substeps
    monkeypatch.setattr(speed, "race", lambda competitors, *_: dict.fromkeys(competitors, times))
    first, second = speed.measure_physics(parse(speed.Args, None, ["--num-envs", "2", "--states", "1"]), "hopper")
    assert (first["scene"], second["scene"]) == ("", "rough ground")
    columns = "forward (us/substep)", "backward (us/substep)", "mj_step, one core (us/substep)", "mj_step/forward"
    assert [first[column] for column in columns] == pytest.approx([10, 40, 20, 2])


def test_a_line_for_each_value_by_its_x() -> None:
    rows = [{"n": "64", "us": "2", "task": "ant"}, {"n": "8", "us": "1", "task": "ant"}]
    first, second = lines([*rows, {"n": "8", "us": "3", "task": "hopper"}], "n", "us", "task")
    assert (first.label, [*first.x], [*first.y]) == ("ant", [8.0, 64.0], [1.0, 2.0])
    assert (second.label, second.style) == ("hopper", "C1o-") and Panel([first, second]).log == ""

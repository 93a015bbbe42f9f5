"""What benchmarks/transfer.py measures in its worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import transfer
from common import parse
from learners import refusal
from tables import markdown, read_csv

import diffsim

POLICIES = Path(diffsim.__file__).parent / "policies"


def test_the_summary_of_a_known_motion() -> None:
    """A hopper glides along; the second episode ends after half of it."""
    env = diffsim.make("hopper", 2)
    qpos, qvel = np.zeros((61, 2, 6)), np.zeros((61, 2, 6))
    qpos[..., 0] = 1.5 * env.control_dt * np.arange(61)[:, None]
    motion = transfer.Motion(qpos, qvel, np.array([3.0, 1.0]), np.array([60, 30]), np.array([False, True]))
    assert transfer.summary(motion, env) == pytest.approx({"return": 2.0, "speed": 1.5, "whole": 0.5})


def test_the_command_writes_a_row_for_each_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is kept counts from the world of the training, here or, in mujoco_warp, that of the same law."""
    state = torch.load(POLICIES / "hopper.pt", weights_only=True)
    exact = {"contact": "mujoco", "integrator": "mujoco", "substeps": 4, "theta": 0.0, "passes": 4, "seed": 1}
    paths = [POLICIES / "hopper.pt", POLICIES / "cartpole.pt"]
    for simulator in ("diffsim", "mujoco_warp"):
        paths.append(tmp_path / simulator / "hopper__1" / "checkpoint.pt")
        paths[-1].parent.mkdir(parents=True)
        torch.save(state | {"args": state["args"] | exact, "simulator": simulator}, paths[-1])
    flags = "--episodes 2 --steps 30 --friction 1 0.5 --output".split()
    transfer.main(parse(transfer.Args, None, [*map(str, paths), *flags, str(tmp_path)]))
    rows = read_csv(tmp_path / "transfer.csv")
    lines = {line["learner"]: line for line in transfer.table(rows)}
    assert markdown(transfer.table(rows)) in capsys.readouterr().out
    worlds = ["here", "finer", "MuJoCo x1", "MuJoCo x0.5"]
    for learner, names, judge in (
        ("policies/hopper", worlds, "MuJoCo x1"),
        ("diffsim", ["here", "finer", "MuJoCo same", *worlds[2:]], "MuJoCo x1"),
        ("mujoco_warp", ["MuJoCo same", "here", "finer", *worlds[2:]], "here"),
    ):
        own = {row["condition"]: row for row in rows if row["checkpoint"].startswith(learner)}
        speed = {name: float(row["speed"]) for name, row in own.items()}
        assert sorted(own) == sorted(names)
        assert "MuJoCo same" in own or speed["finer"] == pytest.approx(speed["here"], rel=0.02)
        kept = float(own[judge]["kept"])
        assert kept == pytest.approx(speed[judge] / speed[names[0]], rel=0.01)
        assert lines[learner]["retained (worst)"] == f"{kept:.0%} ({kept:.0%})"
        if "MuJoCo same" in own:  # one law
            assert speed["here"] == pytest.approx(speed["MuJoCo same"], rel=0.01)
    alone = [row for row in rows if row["task"] == "cartpole"]  # which touches nothing: a return, the same in MuJoCo
    assert [row["condition"] for row in alone] == ["here", "finer", "MuJoCo x1"]
    assert all(row["return"] and not row["speed"] for row in alone)
    line = lines["policies/cartpole"]
    assert float(line["here"]) == pytest.approx(float(line["MuJoCo x1"]), rel=0.02) and line["retained (worst)"] == ""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "of what? give a checkpoint"),
        ("none.pt", "no such checkpoint: "),
        ("humanoid_mtu.pt", "humanoid_mtu, whose muscles are not simulated in MuJoCo here"),
        ("other.pt", "was trained elsewhere: unknown task 'juggler': choose from cartpole, hopper"),
    ],
)
def test_what_cannot_be_compared(name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = POLICIES / name if name == "humanoid_mtu.pt" else tmp_path / name
    if name == "other.pt":
        state = torch.load(POLICIES / "cartpole.pt", weights_only=True)
        torch.save(state | {"args": state["args"] | {"env": "juggler"}}, path)
    args = parse(transfer.Args, None, [str(path)] if name else [])
    assert message in refusal(lambda: transfer.main(args), capsys)

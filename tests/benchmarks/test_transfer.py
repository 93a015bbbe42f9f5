"""What benchmarks/transfer.py measures in its worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import transfer
from common import DOCS, RESULTS, parse
from learners import refusal
from tables import markdown, read_csv

import diffsim
from diffsim.training import gait

POLICIES = Path(diffsim.__file__).parent / "policies"
DT = 1 / 60


def test_the_summary_of_a_known_motion() -> None:
    """A stiff hopper glides along with its foot 10 mm deep, then 30 mm; the second episode ends after half of it."""
    env = diffsim.make("hopper", 2, stochastic_init=False, dtype=torch.float64)
    scene, rest = env.scene, env.qpos[:1].numpy()
    depth = gait.trace(scene, rest)[0]
    t = DT * np.arange(61)
    qpos, qvel = np.tile(rest, (61, 2, 1)), np.zeros((61, 2, scene.nv))
    qpos[..., 0], qvel[..., 0] = 1.5 * t[:, None], 1.5
    qpos[..., 1] += depth.max() - np.where(t < 0.7, 0.01, 0.03)[:, None]
    motion = transfer.Motion(qpos, qvel, np.array([3.0, 1.0]), np.array([60, 30]), np.array([False, True]))
    found = transfer.summary(motion, env)
    assert found == pytest.approx({"return": 2.0, "speed": 1.5, "whole": 0.5, "penetration": 10.0})
    qpos[..., 1] += 1.0
    assert transfer.penetration(motion, scene) == ""  # in flight


@pytest.mark.parametrize("simulator", ["diffsim", "mujoco_warp"])
def test_what_is_kept_counts_from_the_world_of_the_training(simulator: str, tmp_path: Path) -> None:
    state = torch.load(POLICIES / "hopper.pt", weights_only=True)
    exact = {"contact": "mujoco", "integrator": "mujoco", "substeps": 4, "theta": 0.0, "passes": 4}
    path, folder = tmp_path / "ppo" / "hopper__1" / "checkpoint.pt", tmp_path / "csv"
    path.parent.mkdir(parents=True)
    args = state["args"] | exact | {"seed": 1}
    torch.save(state | {"args": args} | ({"simulator": simulator} if simulator != "diffsim" else {}), path)
    flags = "--episodes 2 --steps 20 --friction 1 --output".split()
    transfer.main(parse(transfer.Args, None, [str(path), *flags, str(folder)]))
    rows = {row["condition"]: row for row in read_csv(folder / "transfer.csv")}
    trained, judge = ("here", "MuJoCo x1") if simulator == "diffsim" else ("MuJoCo same", "here")
    assert {*rows} == {"here", "finer", "MuJoCo same", "MuJoCo x1"} and [*rows][0] == trained
    kept = float(rows[judge]["speed"]) / float(rows[trained]["speed"])
    assert float(rows[trained]["kept"]) == 1 and float(rows[judge]["kept"]) == pytest.approx(kept, rel=0.01)
    assert float(rows["here"]["speed"]) == pytest.approx(float(rows["MuJoCo same"]["speed"]), rel=0.01)  # one law
    (line,) = transfer.table([*rows.values()])
    assert (line["judged in"], line["kept"]) == (judge, f"{float(rows[judge]['kept']):.0%}")


def test_the_command_writes_a_row_for_each_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(POLICIES / f"{name}.pt") for name in ("hopper", "cartpole")]
    flags = "--episodes 2 --steps 50 --friction 1 0.5 --output".split()
    transfer.main(parse(transfer.Args, None, [*paths, *flags, str(tmp_path)]))
    rows = read_csv(tmp_path / "transfer.csv")
    hopper, cartpole = ([row for row in rows if row["task"] == name] for name in ("hopper", "cartpole"))
    assert [row["condition"] for row in hopper] == ["here", "finer", "MuJoCo x1", "MuJoCo x0.5"]
    assert [row["condition"] for row in cartpole] == ["here", "finer", "MuJoCo x1"]
    assert all(row["contact"] == "soft" and float(row["penetration"]) > 0 for row in hopper)
    here, finer, own, _ = (float(row["speed"]) for row in hopper)
    assert finer == pytest.approx(here, rel=0.02) and float(hopper[2]["kept"]) == pytest.approx(own / here, rel=0.01)
    assert all(row["return"] and not row["speed"] + row["penetration"] for row in cartpole)
    alone, travelling = transfer.table(rows)
    assert markdown([alone, travelling]) in capsys.readouterr().out
    # Cartpole touches nothing: a return, the same in MuJoCo.
    assert float(alone["here"]) == pytest.approx(float(alone["MuJoCo x1"]), rel=0.02) and alone["kept"] == ""
    assert (travelling["learner"], travelling["here"]) == ("policies/hopper", f"{here:.2f}")


def test_the_page_has_the_table_of_the_csv_file(capsys: pytest.CaptureFixture[str]) -> None:
    """Medians over seeds, the worst of what is kept, shares of each friction."""
    transfer.main(transfer.Args(draw_only=True, output=RESULTS / "cpu"))
    assert capsys.readouterr().out.strip() in (DOCS / "transfer.md").read_text()


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


def test_a_video_shows_both_worlds(opengl: None, tmp_path: Path) -> None:
    env = diffsim.make("hopper", 1)
    qpos = env.qpos.double().numpy()
    motion = transfer.Motion(np.stack([qpos] * 9), np.zeros((9, 1, 6)), np.zeros(1), np.array([8]), np.array([False]))
    transfer.film(tmp_path / "both.gif", env, motion, motion)
    assert (tmp_path / "both.gif").stat().st_size > 1_000

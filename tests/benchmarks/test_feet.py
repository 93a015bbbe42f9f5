"""The feet's trajectories of benchmarks/feet.py: geometry, and a policy that tracks perfectly or falls."""

from __future__ import annotations

from pathlib import Path

import feet
import mujoco
import numpy as np
import pytest
import torch
from common import Case, parse
from learners import refusal
from robustness import Walkers
from tables import read_csv

import diffsim
from diffsim.tasks import HumanoidImitation
from diffsim.training import SavedPolicy


def case(env: diffsim.DiffEnv, seed: int = 1) -> Case:
    still = torch.nn.Linear(env.task.obs_dim, env.scene.nu)
    args = {"algorithm": "ppo", "policy": "pfpn", "seed": seed}
    return Case("a/b", Path("a/b/checkpoint.pt"), SavedPolicy(still, "pfpn", args, 1), env)


def test_feet_are_seen_from_the_trunk() -> None:
    env = diffsim.make("humanoid_imitation")
    model, task = env.scene.mj_model, env.task
    assert isinstance(task, HumanoidImitation)
    qpos = task.clip.qpos[:3].double().numpy()
    moved, turn = qpos.copy(), np.array([0.5, 0.5, 0.5, 0.5])
    moved[:, :3] += 7.0
    for row in moved:
        mujoco.mju_mulQuat(row[3:7], turn, row[3:7].copy())
    here = feet.feet(env.scene, qpos)
    np.testing.assert_allclose(feet.feet(env.scene, moved), here, atol=1e-12)
    knee = model.joint("left_knee").qposadr[0]
    moved[:, knee] += 0.1
    change = np.abs(feet.feet(env.scene, moved) - here)
    assert change[:, :3].max() < 1e-12 and change[:, 3:].max() > 0.01  # right foot first
    assert (np.abs(here) < 1.5).all()


def test_a_policy_that_tracks_covers_the_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as it stands: the third cycle ends early here."""
    env = diffsim.make("humanoid_imitation")
    task = env.task
    assert isinstance(task, HumanoidImitation)

    def walk(walkers: Walkers, seconds: float) -> object:
        assert round(seconds / env.control_dt) == 4 * task.period
        for k in range(1, 2 * task.period + 6):
            qpos = task.clip.qpos[k % task.period].unsqueeze(0).clone()
            qpos[:, :3] += k
            yield walkers.start._replace(qpos=qpos), torch.tensor([k == 2 * task.period + 5])

    monkeypatch.setattr(Walkers, "walk", walk)
    args = parse(feet.Args, "", ["--output", str(tmp_path), "--cycles", "4"])
    for seed in (1, 2):
        feet.measure(case(env, seed), args)
    rows = read_csv(tmp_path / "feet.csv")
    reference, own = ([row for row in rows if row["policy"] == name] for name in (feet.REFERENCE, "pfpn ppo pfpn"))
    assert len(reference) == task.period and len(own) == 2 * (2 * task.period + 4)
    assert all(float(row["error"]) < 1e-3 for row in rows)
    at = {row["frame"]: (row["first"], row["second"]) for row in reference}
    assert all((row["first"], row["second"]) == at[row["frame"]] for row in own)
    spread = np.array([[float(x) for x in place] for place in at.values()]).std(0)
    assert spread[0] >= spread[1] > 0.01  # principal components
    assert "| pfpn ppo pfpn | 48 48 | 0.0 0.0 |" in feet.report(args)


def test_other_tasks_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    args = parse(feet.Args, "", ["--output", str(tmp_path)])
    error = refusal(lambda: feet.measure(case(diffsim.make("ant")), args), capsys)
    assert "trained on ant; this needs humanoid_imitation" in error

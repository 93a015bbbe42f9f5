"""How benchmarks/tracking.py judges policies that track clips."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import tracking
from learners import refusal
from torch import Tensor, nn
from worlds import OtherFile

import diffsim
from diffsim import Clip
from diffsim.tasks.imitation.tracking import G1Track
from diffsim.training import SavedPolicy

POLICIES = Path(diffsim.__file__).parent / "policies"


class Nothing(nn.Module):
    """Leaves the servos the reference's joints."""

    def forward(self, obs: Tensor) -> Tensor:
        return torch.zeros(len(obs), 29)


def test_who_stands_succeeds_and_who_is_to_fly_fails() -> None:
    home = torch.from_numpy(diffsim.load_scene(Path(diffsim.__path__[0]) / "assets/g1.xml").mj_model.key_qpos[0])
    still = home.expand(31, -1).clone()
    flight = still.clone()
    flight[:, 2] += torch.linspace(0, 2, 31, dtype=flight.dtype)
    clip = Clip("two", torch.cat((still, flight)), False, (31, 31))
    env = diffsim.make("g1_track", 1, clip=clip)
    task = G1Track(dtype=torch.float64, clip=clip)
    task.bind(env.scene)
    args, saved = tracking.Args(episodes=3, push=0.1), SavedPolicy(nn.Sequential(Nothing()), "nothing", {}, 1)
    success, (root, turn, joints) = tracking.track(saved, task, OtherFile(env, 6, None, 1.0), args)
    assert success.tolist() == [True] * 3 + [False] * 3
    assert (root[:3] < 0.05).all() and (root[3:] > 0.1).all() and (turn[:3] < 0.1).all() and (joints < 0.1).all()


def test_a_row_for_each_friction_and_a_line_for_each_clip() -> None:
    row = dict(task="g1_track", clip="walk", motions="1", learner="sapo --randomise", file="g1", push="0", success="1")
    row |= {"training s": "100", "joint error": "0.06", "root error": "0.04", "seed": "1", "whole motions": "1"}
    rows = [row | dict(checkpoint=f"h100/{k}", friction=str(f)) for k in (1, 2) for f in (0.7, 1, 1.3)]
    rows[0]["success"], rows[-2]["success"] = "0.5", "0.8"
    (line,) = tracking.table([*rows, row | dict(checkpoint="h100/1", friction="1", push="0.5", success="0.25")])
    assert (line["policy"], line["seeds"], line["training (s)"]) == ("walk, sapo, h100", 2, "100")
    assert (line["success"], line["pushed"]) == ("90% (50%)", "25%")
    assert (line["joints (rad)"], line["root (m)"]) == ("0.060", "0.040")
    (line,) = tracking.table([row | dict(checkpoint="h100/1", friction="1", learner="sapo")])
    assert (line["policy"], line["success"], line["pushed"]) == ("walk, sapo, h100, not randomised", "100% (100%)", "")

    shared = row | {"checkpoint": "h100_shared/3", "friction": "1", "training s": "300"}
    (line,) = tracking.table([*rows, shared])
    assert (line["seeds"], line["training (s)"]) == (3, "100")
    several = row | {
        "checkpoint": "h100/all",
        "friction": "1",
        "motions": "44",
        "success": "0.9",
        "whole motions": "40",
    }
    (line,) = tracking.many([*rows, several, several | {"friction": "1.3"}])
    assert (line["motions"], line["success"], line["motions with 95%"]) == ("44", "90%", "40")
    variant = row | {"checkpoint": "ablation/horizon_8", "friction": "0.7", "success": "0.5", "iteration": "600"}
    variants = [several, variant, variant | {"friction": "1", "success": "1"}, variant | {"push": "0.5"}]
    assert len(tracking.table([*rows, *variants])) == 1
    (line,) = tracking.ablation([*rows, *variants])
    assert (line["variant"], line["success"], line["pushed"]) == ("horizon 8", "100% (50%)", "50%")


def test_a_race_ends_with_the_first_checkpoint_that_succeeds() -> None:
    row = dict(clip="walk", learner="sapo --randomise --initial-log-std -2", seed="1") | {"joint error": "0.06"}
    rows = [row | {"training s": str(s), "success": share} for s, share in ((90, "1"), (20, "0.5"), (60, "0.96"))]
    rows.append(row | {"learner": "ppo --initial-log-std -1 in mujoco_warp", "training s": "70", "success": "0.1"})
    sapo, ppo = tracking.race(rows)
    assert (sapo["learner"], sapo["s to 95%"], sapo["in all (s)"], sapo["last success"]) == ("sapo", "60", "90", "100%")
    assert ppo["learner"] == "ppo in mujoco_warp"
    assert (ppo["s to 95%"], ppo["last success"]) == ("never", "10%")


def test_what_cannot_be_judged(capsys: pytest.CaptureFixture[str]) -> None:
    args = tracking.Args(checkpoints=(POLICIES / "hopper.pt",))
    error = refusal(lambda: tracking.main(args), capsys)
    assert "was trained on hopper, which is not judged by its clip's root" in error

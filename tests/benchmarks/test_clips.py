"""How benchmarks/tracking.py judges policies that track clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import tracking
from torch import Tensor, nn
from worlds import OtherFile

import diffsim
from diffsim.extra.robots.imitation.clip import Clip, read_clip
from diffsim.extra.robots.imitation.tracking import G1Track
from diffsim.training import SavedPolicy
from diffsim.training.checkpoint import POLICIES


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
    env = diffsim.make(G1Track.with_clip(clip), 1)
    task = G1Track.with_clip(clip)(dtype=torch.float64)
    task.bind(env.scene)
    args, saved = tracking.Args(episodes=3, push=0.1), SavedPolicy(nn.Sequential(Nothing()), "nothing", {}, 1)
    success, (root, turn, joints) = tracking.track(saved, task, OtherFile(env, 6, None, 1.0), args)
    assert success.tolist() == [True] * 3 + [False] * 3
    assert (root[:3] < 0.05).all() and (root[3:] > 0.1).all() and (turn[:3] < 0.1).all() and (joints < 0.1).all()


def test_another_clip_leaves_the_servos_their_range(tmp_path: Path) -> None:
    karate = read_clip("g1_karate").qpos[:91]  # whose joints move less than in all of it
    np.savez(file := tmp_path / "beginning.npz", qpos=karate, fps=60, loop=False)
    (row,) = tracking.measure(tracking.Args(clip=file, episodes=2, friction=(1.0,)), POLICIES / "g1_track.pt")
    assert row["success"] == 1 and row["joint error"] < 0.05


def test_tables_of_policies_variants_and_races() -> None:
    row = {"clip": "walk", "motions": "1", "seed": "1", "checkpoint": "h100/1", "push": "0", "success": "1"}
    row |= {"learner": "sapo randomised", "device": "cuda", "training s": "100"}
    row |= {"joint error": "0.06", "root error": "0.04"}
    rows = [row | {"friction": f, "success": s} for f, s in (("0.7", "0.5"), ("1", "0.9"))]
    shared = row | {"checkpoint": "h100_shared/2", "friction": "1", "training s": "300"}
    several = row | {"checkpoint": "h100/all", "friction": "1", "motions": "44", "whole motions": "40"}
    (line,) = tracking.table([*rows, shared, several])
    assert (line["policy"], line["seeds"], line["training (s)"]) == ("walk", 2, "100")
    assert (line["success"], line["pushed"]) == ("95% (50%)", "")
    (line,) = tracking.many([*rows, several, several | {"friction": "1.3"}])
    assert (line["motions"], line["motions with 95%"]) == ("44", "40")
    way = [
        row
        | {"checkpoint": f"sapo__1/at_{k}", "iteration": str(k), "control steps": f"{k}e5"}
        | {"training s": str(k + 10), "success": share}
        for k, share in ((90, "1"), (20, "0.5"), (40, "0.95"), (60, "0.94"), (80, "0.96"))
    ]
    never = way[1] | {"checkpoint": "ppo_in_mujoco_warp__1/at_20", "success": "0.1"}
    shared = way[2] | {"checkpoint": "window_8__1_shared/at_40"}
    sapo, ppo = tracking.race([*way, never, shared])
    assert list(sapo.values())[:5] == ["sapo", "0.06", "4", "50", "90"]
    assert (ppo["training"], ppo["s to 95%"], ppo["last success"]) == ("ppo in mujoco warp", "never", "10%")
    (window,) = tracking.race([*way, never, shared], shared=True)
    assert window == {"training": "window 8", "M steps": "4", "last success": "95%"}

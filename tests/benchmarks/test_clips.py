"""How benchmarks/tracking.py judges policies that track clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import tracking
from torch import Tensor, nn
from worlds import OtherFile

import diffsim
from diffsim.training import SavedPolicy
from diffsim.training.checkpoint import POLICIES
from diffsim_robots.imitation.clip import Clip, read_clip
from diffsim_robots.imitation.tracking import G1Track


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

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


def test_what_cannot_be_judged(capsys: pytest.CaptureFixture[str]) -> None:
    args = tracking.Args(checkpoints=(POLICIES / "hopper.pt",))
    error = refusal(lambda: tracking.main(args), capsys)
    assert "was trained on hopper, which is not judged by its clip's root" in error

"""mujoco_warp as the simulator of a task, and what benchmarks/peer.py makes of it. Slow: it compiles for a minute."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import peer
import pytest
import torch
import worlds
from common import parse
from tables import read_csv

import diffsim

pytest.importorskip("mujoco_warp")


@pytest.mark.slow
@torch.no_grad()
@pytest.mark.parametrize(("name", "share", "tolerance"), [("hopper", 0.95, 1e-4), ("go2", 0.5, 1e-3)])
def test_a_step_is_mujoco_s_and_ours(name: peer.Name, share: float, tolerance: float) -> None:
    """Through a fall to the ground, with a reset; and a robot that is lost stays where it was."""
    env = diffsim.make(name, 2, seed=0, contact="mujoco", max_episode_steps=40)
    other = peer.MuJoCoWarp(env.sim, name)
    world = worlds.MuJoCo(env.scene, 2, env.control_dt, 1.0, True, env.sim.integration.substeps)
    errors, touching = [], 0
    for _ in range(60):
        action = 2 * torch.rand(2, env.scene.nu, generator=env.generator) - 1
        expected = world.step(env.qpos.double(), env.qvel.double(), action)[:2]
        found = [sim.step(env.qpos, env.qvel, action) for sim in (other, env.sim)]
        errors.append([[(x - y).abs().max().item() for x, y in zip(f, expected, strict=True)] for f in found])
        touching += sum(data.ncon for data in world.data)
        env.step(action)
    assert (np.quantile(errors, share, axis=0) < tolerance).all()  # rounding decides when a contact begins or slips
    assert touching and other.lost() == 0 and not other.nonfinite.any()
    qvel = torch.tensor([0.0, 2e5])[:, None] * torch.eye(env.scene.nv)[0]
    assert (other.step(env.qpos, qvel, action)[0][1] == env.qpos[1]).all() and other.nonfinite.tolist() == [False, True]


def test_the_command(tmp_path: Path) -> None:
    flags = ["--device", "cpu", "--env", "hopper", "--output", str(tmp_path)]
    peer.main(parse(peer.Args, None, [*flags, "--num-envs", "2", "--repeats", "1"]))
    (row,) = read_csv(tmp_path / "peer_speed.csv")
    assert row["lost"] == "0" and all(float(row[name]) > 0 for name in ("mujoco_warp", "here", "forward and backward"))

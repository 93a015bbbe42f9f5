"""mujoco_warp as the simulator of a task, and what benchmarks/peer.py makes of it. Slow: it compiles for a minute."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import peer
import pytest
import torch
import worlds
from common import parse
from learners import refusal
from tables import read_csv

import diffsim
from diffsim.training import load_policy
from diffsim_cli.watch import make_policy_env

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
    env.sim = other
    env.advance(action)
    assert torch.equal(env.qpos, other._qpos)  # which an environment steps, too


def test_the_commands(tmp_path: Path) -> None:
    flags = ["--device", "cpu", "--env", "hopper", "--output", str(tmp_path)]
    peer.main(parse(peer.Args, None, [*flags, "--num-envs", "2", "--repeats", "1"]))
    (row,) = read_csv(tmp_path / "peer_speed.csv")
    assert row["lost"] == "0" and all(
        float(row[name]) > 0 for name in ("mj_step", "mujoco_warp", "here", "forward and backward")
    )
    own = "--num-envs 2 --minibatch-size 8 --horizon 4 --eval-episodes 2 --quiet".split()
    training = ["--parts", "train", "--seconds", "0.1", "--runs", str(tmp_path), "--", *own]
    peer.main(parse(peer.Args, None, [*flags, *training]))
    (row,) = read_csv(tmp_path / "peer_train.csv")
    saved = load_policy(tmp_path / "ppo_mujoco_warp" / "hopper__1" / "checkpoint.pt")
    assert (saved.simulator, saved.script, saved.iteration) == ("mujoco_warp", "ppo_baseline", int(row["iteration"]))
    assert make_policy_env(saved, 1).sim.integration == diffsim.Integration("mujoco", 4)


def test_what_mujoco_warp_does_not_vary(capsys: pytest.CaptureFixture[str]) -> None:
    args = parse(peer.Args, None, "--device cpu --env hopper --parts train -- --env hopper:friction=0.7:1.3".split())
    assert "leave out --contact and ranges after the task's name" in refusal(lambda: peer.main(args), capsys)

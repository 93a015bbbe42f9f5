"""Record the clips of examples/servo_tasks.py: the cycles of two motions that end closest to where they begin.

python tools/record_examples.py

dog_trot.npz: the shipped go2 policy's trot. The file in examples/ is of SHAC's seed 5, which was shipped before RPO's.
humanoid_jog.npz: two strides of gps.py's example, 2.4 m/s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from record import close, cycle
from torch import Tensor

import diffsim
from diffsim.tasks.base import ASSETS
from diffsim.training import load_policy
from diffsim_robots.imitation.clip import Clip

COMMAND = (0.8, 0.0, 0.0)  # m/s forward, which the recorded dog follows
PERIOD = 25  # control steps of go2 in a cycle of its gait
JOG = 54  # frames of two strides, 60 a second: an even number, so that a task of 30 steps a second keeps their period


@torch.no_grad()
def trot(steps: int = 350, settling: int = 150) -> Clip:
    """The best cycle of four episodes, after some steps of settling."""
    policy = load_policy(ASSETS.parent / "policies" / "go2.pt").network
    env = diffsim.make("go2", num_envs=4, seed=1)
    env.reset(seed=1)
    frames, action = list[Tensor](), torch.zeros(4, env.scene.nu)
    for _ in range(steps):
        env.memory[:, :3] = torch.tensor(COMMAND)
        action = policy(env.observe(env.qpos, env.qvel, action))
        env.step(action)
        frames.append(env.qpos.double().clone())
    found = (cycle(motion, PERIOD, PERIOD) for motion in torch.stack(frames[settling:], dim=1))
    qpos, _ = min(found, key=lambda each: each[1])
    return Clip("dog_trot", close(qpos), loop=True)


def jog(settling: int = 60) -> Clip:
    """The best cycle of two strides."""
    with np.load(ASSETS / "examples" / "humanoid.npz") as example:
        qpos, _ = cycle(torch.from_numpy(example["qpos"]).double()[settling:], JOG, JOG)
    return Clip("humanoid_jog", close(qpos), loop=True)


if __name__ == "__main__":
    for clip, fps in ((trot(), 50), (jog(), 60)):
        path = Path(__file__).resolve().parents[1] / "examples" / f"{clip.name}.npz"
        np.savez_compressed(path, qpos=clip.qpos.numpy().astype(np.float32), fps=fps)
        print(path)

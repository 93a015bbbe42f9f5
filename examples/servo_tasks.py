"""Imitation as in the PFPN paper: a policy sets the targets of servos 30 times a second. A humanoid and a dog.

python pfpn.py --env examples/servo_tasks.py:HumanoidServo --seed 1
python pfpn.py --env examples/servo_tasks.py:Dog --clip examples/dog_trot.npz --seed 1
python examples/servo_tasks.py                         records that clip again, from the shipped policy of go2
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

import diffsim
from diffsim.tasks import Contact, HumanoidImitation
from diffsim.tasks.base import ASSETS
from diffsim.tasks.imitation.clip import Clip
from diffsim.tasks.joystick import Go2
from diffsim.training import load_policy

STIFFNESS = 2.0  # 1/rad: a servo gives its motor's largest torque half a radian from the target
COMMAND = (0.8, 0.0, 0.0)  # m/s forward, which the recorded dog follows
PERIOD = 25  # control steps of go2 in a cycle of its gait


def with_servos(file: str) -> mujoco.MjModel:
    """A robot whose motors hold targets: actions of -1 and 1 are the joints' limits. Joints have their own dampers."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / file))
    for actuator in spec.actuators:
        most, actuator.ctrlrange = actuator.gear[0], [0, 0]
        actuator.set_to_position(kp=STIFFNESS * most, inheritrange=1.0)
        actuator.gear, actuator.forcerange = [1, 0, 0, 0, 0, 0], [-most, most]
    return spec.compile()


class HumanoidServo(HumanoidImitation):
    """21 joints; action: targets of the servos."""

    name, asset = "humanoid_servo", with_servos("humanoid.xml")
    contact: ClassVar[Contact] = "mujoco"
    control_dt, episode_length, substeps = 1 / 30, 600, 8  # 20 s


class Dog(HumanoidImitation):
    """The robot of go2, 12 joints; action: targets of its servos."""

    name, asset = "dog", Go2.asset
    contact: ClassVar[Contact] = "mujoco"
    control_dt, episode_length, substeps = 1 / 30, 600, 8
    obs_dim = 39
    ends = ("FL", "FR", "RL", "RR")

    def terminated(self, obs: Tensor) -> Tensor:
        """The root is low, or as for the humanoid; only the feet have contact."""
        return super().terminated(obs) | (obs[..., 0] < 0.6 * Go2.robot.height)


@torch.no_grad()
def record(steps: int = 350, settling: int = 150) -> Clip:
    """The cycle of go2's trot that ends closest to where it begins."""
    sys.path.append(str(ASSETS.parents[1] / "tools"))
    from record import close, cycle

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


if __name__ == "__main__":
    path = Path(__file__).with_name("dog_trot.npz")
    np.savez_compressed(path, qpos=record().qpos.numpy().astype(np.float32), fps=50)
    print(path)

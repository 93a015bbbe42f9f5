"""Imitation as in the PFPN paper: a policy sets the targets of servos 30 times a second. A humanoid and a dog.

python pfpn.py --env examples/servo_tasks.py:HumanoidServo --seed 1
python pfpn.py --env examples/servo_tasks.py:Dog --seed 1
python tools/record_examples.py                         records the clips
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import mujoco
from torch import Tensor

from diffsim.tasks import Contact
from diffsim.tasks.base import ASSETS
from diffsim_robots.imitation.task import HumanoidImitation
from diffsim_robots.unitree import Go2

STIFFNESS = 2.0  # 1/rad: a servo gives its motor's largest torque half a radian from the target


def with_servos(file: str) -> mujoco.MjModel:
    """A robot whose motors hold targets: actions of -1 and 1 are the joints' limits. Joints have their own dampers."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / file))
    for actuator in spec.actuators:
        most, actuator.ctrlrange = actuator.gear[0], [0, 0]
        actuator.set_to_position(kp=STIFFNESS * most, inheritrange=1.0)
        actuator.gear, actuator.forcerange = [1, 0, 0, 0, 0, 0], [-most, most]
    return spec.compile()


class HumanoidServo(HumanoidImitation):
    """21 joints; action: targets of the servos. It jogs: no policy kept the run of humanoid_imitation, 8.5 m/s."""

    name, asset, like = "humanoid_servo", with_servos("humanoid.xml"), None
    default_clip = str(Path(__file__).with_name("humanoid_jog.npz"))
    contact: ClassVar[Contact] = "mujoco"
    control_dt, episode_length, substeps = 1 / 30, 600, 8  # 20 s


class Dog(HumanoidImitation):
    """The robot of go2, 12 joints; action: targets of its servos."""

    name, asset, like = "dog", Go2.asset, None
    contact: ClassVar[Contact] = "mujoco"
    control_dt, episode_length, substeps = 1 / 30, 600, 8
    obs_dim = 39
    default_clip = str(Path(__file__).with_name("dog_trot.npz"))
    ends = ("FL", "FR", "RL", "RR")

    def terminated(self, obs: Tensor) -> Tensor:
        """The root is low, or as for the humanoid; only the feet have contact."""
        return super().terminated(obs) | (obs[..., 0] < 0.6 * Go2.robot.height)

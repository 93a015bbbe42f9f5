"""The tasks, one file each."""

from __future__ import annotations

from diffsim.tasks.ant import Ant
from diffsim.tasks.base import Accuracy, Contact, Task
from diffsim.tasks.cartpole import CartPole
from diffsim.tasks.half_cheetah import HalfCheetah
from diffsim.tasks.hopper import Hopper
from diffsim.tasks.humanoid import Humanoid
from diffsim.tasks.humanoid_mtu import HumanoidMTU
from diffsim.tasks.imitation.task import HumanoidImitation
from diffsim.tasks.joystick import G1, Go1, Go2
from diffsim.tasks.swimmer import Swimmer
from diffsim.tasks.walker import Walker

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (CartPole, Hopper, HalfCheetah, Ant, Humanoid, HumanoidMTU, Swimmer, Walker, HumanoidImitation, Go1, Go2, G1)
}
# Those of the SHAC paper, which have presets of every accuracy
SHAC_TASKS = ("cartpole", "hopper", "half_cheetah", "ant", "humanoid", "humanoid_mtu")

__all__ = ["SHAC_TASKS", "TASKS", "Accuracy", "Contact", "HumanoidImitation", "Task"]

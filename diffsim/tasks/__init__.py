"""The tasks, one file each."""

from __future__ import annotations

from .ant import Ant
from .base import Accuracy, Contact, Firm, Task
from .cartpole import CartPole
from .half_cheetah import HalfCheetah
from .hopper import Hopper
from .humanoid import Humanoid
from .humanoid_imitation import HumanoidImitation
from .humanoid_mtu import HumanoidMTU
from .swimmer import Swimmer
from .walker import Walker

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (CartPole, Hopper, HalfCheetah, Ant, Humanoid, HumanoidMTU, Swimmer, Walker, HumanoidImitation)
}
# Those of the SHAC paper, which have presets of every accuracy
SHAC_TASKS = ("cartpole", "hopper", "half_cheetah", "ant", "humanoid", "humanoid_mtu")

__all__ = ["SHAC_TASKS", "TASKS", "Accuracy", "Contact", "Firm", "HumanoidImitation", "Task"]

"""The tasks, one file each."""

from __future__ import annotations

from .ant import Ant
from .base import Accuracy, Task
from .cartpole import CartPole
from .half_cheetah import HalfCheetah
from .hopper import Hopper
from .humanoid import Humanoid
from .humanoid_mtu import HumanoidMTU
from .planar import Swimmer, Walker

TASKS: dict[str, type[Task]] = {task.name: task for task in (CartPole, Hopper, HalfCheetah, Ant, Humanoid, HumanoidMTU)}
PLANAR: dict[str, type[Task]] = {task.name: task for task in (Swimmer, Walker)}  # of guided policy search

__all__ = ["PLANAR", "TASKS", "Accuracy", "Task"]

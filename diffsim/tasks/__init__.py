"""The tasks of the paper, one file each, and the names of all others, which are loaded when they are asked for."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Iterator, Mapping

from diffsim.tasks.base import Accuracy, Contact, Task, TaskError

FILE = re.compile(r"(.+\.py)(?::(\w+))?")  # a task of your own: my_task.py or my_task.py:Class
OWN_TASK = "diffsim.tasks.own_task:task_of_file"
REGISTERED = {
    "cartpole": "diffsim.tasks.cartpole:CartPole",
    "hopper": "diffsim.tasks.hopper:Hopper",
    "half_cheetah": "diffsim.tasks.half_cheetah:HalfCheetah",
    "ant": "diffsim.tasks.ant:Ant",
    "humanoid": "diffsim.tasks.humanoid:Humanoid",
    "humanoid_mtu": "diffsim.tasks.humanoid_mtu:HumanoidMTU",
    # not in the paper
    "swimmer": "diffsim_robots.swimmer:Swimmer",
    "walker": "diffsim_robots.walker:Walker",
    "humanoid_imitation": "diffsim_robots.imitation.task:HumanoidImitation",
    "go1": "diffsim_robots.unitree:Go1",
    "go2": "diffsim_robots.unitree:Go2",
    "g1": "diffsim_robots.unitree:G1",
    "g1_track": "diffsim_robots.imitation.tracking:G1Track",
}


class Tasks(Mapping[str, type[Task]]):
    """The registered tasks by name. A class is imported when it is first looked up."""

    def __getitem__(self, name: str) -> type[Task]:
        return pkgutil.resolve_name(REGISTERED[name])

    def __iter__(self) -> Iterator[str]:
        return iter(REGISTERED)

    def __len__(self) -> int:
        return len(REGISTERED)


TASKS = Tasks()


def base_name(name: str) -> str:
    """Return a task's name without the options that follow it."""
    return name if FILE.fullmatch(name) else name.partition(":")[0]


def find_task(name: str | type[Task]) -> type[Task]:
    """Return the class of a task; raises TaskError if there is none.

    Args:
        name: one of TASKS; one of them with options, "go2:rough=20" or "g1_track:walk.npz", see Task.configured; a file
            with a task of your own, "my_task.py" or "my_task.py:Class"; or a class, which is returned as it is.
    """
    if isinstance(name, type) and issubclass(name, Task):
        return name
    if FILE.fullmatch(str(name)):
        return pkgutil.resolve_name(OWN_TASK)(name)
    base, options = base_name(str(name)), str(name).partition(":")[2]
    if base.endswith(".xml"):
        raise TaskError(f"{base} is a robot without a task: give a file with a class, my_task.py (docs/own_robot.md)")
    if base not in TASKS:
        raise TaskError(f"unknown task {name!r}: choose from {', '.join(TASKS)}, or give a file such as my_task.py")
    return TASKS[base] if name == base else TASKS[base].configured(options)


def restore_task(name: str, stored: dict[str, object]) -> None:
    """Let `find_task` take what a checkpoint stored (Task.stored) in place of the files that its task's name names."""
    if (base := base_name(name)) in TASKS:
        TASKS[base].restore(name.partition(":")[2], stored)

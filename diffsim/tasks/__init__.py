"""The tasks, one file each."""

from __future__ import annotations

from diffsim.tasks.ant import Ant
from diffsim.tasks.base import Accuracy, Contact, Task, TaskError
from diffsim.tasks.cartpole import CartPole
from diffsim.tasks.half_cheetah import HalfCheetah
from diffsim.tasks.hopper import Hopper
from diffsim.tasks.humanoid import Humanoid
from diffsim.tasks.humanoid_mtu import HumanoidMTU
from diffsim.tasks.imitation.task import HumanoidImitation, Imitation
from diffsim.tasks.imitation.tracking import G1Track
from diffsim.tasks.joystick import G1, Go1, Go2
from diffsim.tasks.own import FILE, task_of_file
from diffsim.tasks.swimmer import Swimmer
from diffsim.tasks.walker import Walker

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        *(CartPole, Hopper, HalfCheetah, Ant, Humanoid, HumanoidMTU, Swimmer, Walker, HumanoidImitation),
        *(Go1, Go2, G1, G1Track),
    )
}


def find_task(name: str | type[Task]) -> type[Task]:
    """The task of a name in TASKS or of a file, my_task.py or my_task.py:Class; a class is one. Raises TaskError."""
    if isinstance(name, type) and issubclass(name, Task):
        return name
    if name not in TASKS and not FILE.fullmatch(str(name)):
        raise TaskError(f"unknown task {name!r}: choose from {', '.join(TASKS)}, or give a file such as my_task.py")
    return TASKS.get(name) or task_of_file(name)

"""`diffsim tune`: what speed costs in accuracy for any robot on this machine, and the setting to take."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from tyro.conf import Positional

import diffsim
from diffsim.sim.integration import check_count
from diffsim.sim.options import check_device
from diffsim.tasks import FILE, Contact, Task, find_task
from diffsim.training import fail, load_policy
from diffsim.training.checkpoint import POLICIES
from diffsim_cli.render import whole_file
from diffsim_cli.tune.extremes import stress
from diffsim_cli.tune.front import Row, choice, flags, front, measure, settings
from diffsim_cli.tune.motion import Motion

SHOWN = 10  # rows of the printed front


def tune(
    robot: Positional[str],
    error: float = 0.01,
    checkpoint: Path | None = None,
    contact: Contact | None = None,
    device: str = "cpu",
    states: int = 32,
    csv: Path | None = None,
    extremes: bool = False,
) -> None:
    """Measure how speed and accuracy trade for a robot on this machine, and choose a setting.

    Args:
        robot: a task, a file my_task.py, or an MJCF file robot.xml.
        error: allowed error of the state after 0.5 s: root mean square over joints [m, rad], median over states.
        checkpoint: policy that moves the robot. Default: the shipped one, or smooth random actions.
        contact: soft or mujoco. Default: the task's.
        device: device whose time is measured; errors are measured on the CPU.
        states: number of start states.
        csv: file to which all rows are written.
        extremes: also find the values with which each integrator fails.
    """
    check_device(device)
    check_count("--states", states)
    if not error > 0:
        fail(f"--error is {error:g}, must be positive")
    task = subject(robot)
    env = diffsim.make(task, states, seed=0, early_termination=False, max_episode_steps=2**31)
    if not env.scene.nu:
        fail(f"{robot} has no actuators, so there is no action to differentiate in")
    policy, source = actor(robot, task, checkpoint)
    motion, rows, presets = Motion(env, policy), list[Row](), task.presets(contact)
    print(f"{task.name}: {states} start states and actions of {source}; control steps of {1e3 * env.control_dt:.4g} ms")
    if "contact" not in env.scene.features:
        print(f"{robot} meets no ground: no contact is measured")
    try:
        measure(motion, settings(task, contact or task.contact), rows, device=device)
    except KeyboardInterrupt:
        print(f"stopped after {len(rows)} settings")
        extremes = False
    if not rows:
        return
    best, names = choice(rows, error), {how: name for name, how in presets.items()}
    shown = [("->" * (row is best), names.get(row.how, ""), row) for row in thin(front(rows), best)]
    print(table([{"": arrow, "preset": name} | row.columns() for arrow, name, row in shown]))
    if best:
        costs = [row.cost for row in rows if row.how == presets["default"]]
        speed = "".join(f", {cost / best.cost:.2g} times as fast as the default" for cost in costs)
        print(f"take {flags(best.how)}: error {best.error:.2g}{speed}")
    else:
        print(f"no setting keeps the state's error after 0.5 s below {error:g}")
    if csv:
        write(csv, [row.columns() for row in rows])
    if extremes:
        print(table(stress(motion, task, contact or task.contact)))


class Watched(Task):
    """A robot of an MJCF file, which nothing is asked of."""

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        return torch.cat((qpos, qvel), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return torch.zeros_like(obs[..., 0])


def subject(robot: str) -> type[Task]:
    """The task of a name or a file; of an MJCF file one is made."""
    path = Path(robot)
    if path.suffix != ".xml":
        return find_task(robot)
    if not path.is_file():
        fail(f"no such file: {robot}")
    return type("Robot", (Watched,), {"name": path.stem, "asset": path.resolve()})


def actor(robot: str, task: type[Task], checkpoint: Path | None) -> tuple[torch.nn.Module | None, str]:
    """The policy, None if actions are random, and what to call it."""
    shipped = POLICIES / f"{task.name}.pt"
    if checkpoint is None and not shipped.is_file():
        return None, "smooth random actions"
    saved = load_policy(checkpoint or shipped)
    own = robot if FILE.fullmatch(robot) else None
    if own is None and (trained := saved.task()) != task.name:
        fail(f"{checkpoint} is a checkpoint of {trained}, not of {robot}")
    return saved.network, f"{saved.script}.py's policy, iteration {saved.iteration}"


def thin(rows: Sequence[Row], best: Row | None) -> list[Row]:
    """At most SHOWN of the rows, by leaving out the nearest in cost, except the first, the last and the best one."""
    rows = [*rows]
    while len(rows) > SHOWN:
        middle = [k for k in range(1, len(rows) - 1) if rows[k] is not best]
        del rows[min(middle, key=lambda k: rows[k + 1].cost / rows[k - 1].cost)]
    return rows


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """The rows under their columns' names, aligned."""
    lines = [list(rows[0]), *(list(row.values()) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def write(path: Path, rows: Sequence[Mapping[str, str]]) -> None:
    with whole_file(path) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)

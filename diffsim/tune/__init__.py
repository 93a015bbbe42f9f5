"""`diffsim tune`: what speed costs in accuracy for any robot on this machine, and the setting to take."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from tyro.conf import Positional

import diffsim
from diffsim.sim.options import check_device
from diffsim.tasks import FILE, Contact, Task, find_task
from diffsim.training import Count, fail, load_policy
from diffsim.training.checkpoint import POLICIES
from diffsim.tune.extremes import stress
from diffsim.tune.front import Row, batches, choice, costs, front, measure, settings
from diffsim.tune.motion import SPANS, Motion, Setting
from diffsim.view.render import whole_file

SHOWN = 10  # rows of the printed front


def tune(
    robot: Positional[str],
    error: float = 0.01,
    checkpoint: Path | None = None,
    contact: tuple[Contact, ...] = (),
    device: str = "cpu",
    states: Count = 32,
    output: Path = Path("tune.png"),
    csv: Path | None = None,
    extremes: bool = False,
) -> None:
    """Measure how speed and accuracy trade for a robot on this machine, and choose a setting.

    Args:
        robot: a task, a file my_task.py, or an MJCF file robot.xml.
        error: of the state after 0.5 s that is allowed: root mean square over joints [m, rad], median over states.
        checkpoint: whose policy moves the robot; default the shipped one, or smooth random actions.
        contact: models of contact to compare; default the task's own.
        device: whose time is measured; errors are measured on the CPU.
        states: start states.
        output: the picture.
        csv: where all rows are written, too.
        extremes: find also what each integrator withstands.
    """
    check_device(device)
    if not error > 0:
        fail(f"--error is {error:g}, must be positive")
    if output.suffix not in (".png", ".svg", ".pdf"):
        fail(f"--output is {output}, must end in .png, .svg or .pdf")
    task = subject(robot)
    env = diffsim.make(task, states, seed=0, early_termination=False, max_episode_steps=2**31)
    if not env.scene.nu:
        fail(f"{robot} has no actuators, so there is no action to differentiate in")
    policy, source = actor(robot, task, checkpoint)
    motion, rows = Motion(env, policy), list[Row]()
    print(f"{task.name}: {states} start states and actions of {source}; control steps of {1e3 * env.control_dt:.4g} ms")
    if "contact" not in env.scene.features:
        print(f"{robot} meets no ground: no contact is measured")
    contacts, stopped = contact or (task.contact,), False
    try:
        for each in contacts:
            measure(motion, settings(task, each), rows, device=device)
    except KeyboardInterrupt:
        stopped = True
        print(f"stopped after {len(rows)} settings")
    if not rows:
        return
    best, usual = choice(rows, error), Setting(task.integration("default", contacts[0]))
    default = next((row for row in rows if row.setting == usual), None)
    names = {Setting(how): name for each in contacts for name, how in task.presets(each).items()}
    shown = [("->" * (row is best), names.get(row.setting, ""), row) for row in thin(front(rows), best)]
    print(table([{"": arrow, "preset": name} | row.columns() for arrow, name, row in shown]))
    print(verdict(best, default, error))
    if csv:
        write(csv, [row.columns() for row in rows])
    draw(output, rows, best, default, task.name)
    if stopped:
        return
    setting = best.setting if best else usual
    per_call = ", ".join(f"{n} {us:.3g}" for n, us in batches(motion, setting, device).items())
    print(f"environments per call, us of a control step with gradient: {per_call}")
    whole, *parts = costs(motion, setting, device).items()
    shares = ", ".join(f"{part} {us:.2g}" for part, us in parts)
    print(f"of {whole[1]:.3g} us the scene pays for {shares or 'nothing that can be left out'}")
    if extremes:
        print(table(stress(motion, task, contacts)))


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


def verdict(best: Row | None, default: Row | None, error: float) -> str:
    if best is None:
        return f"no setting keeps the state's error after {SPANS[-1]} s below {error:g}"
    speed = f", {default.cost / best.cost:.2g} times as fast as the default" if default else ""
    return f"take {best.setting.flags}: error {best.error:.2g}{speed}"


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


def draw(path: Path, rows: Sequence[Row], best: Row | None, default: Row | None, title: str) -> None:
    """Error against cost of all rows, the front as a line."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print("no picture: pip install matplotlib")
        return
    figure = Figure(figsize=(9, 4), layout="constrained")
    columns = {f"state {SPANS[-1]:g} s": "state's error [m, rad]", "gradient 8": "gradient's relative error, 8 steps"}
    for axis, (column, label) in zip(figure.subplots(1, 2), columns.items(), strict=True):
        for kind in dict.fromkeys(row.setting.kind for row in rows):
            own = [row for row in rows if row.setting.kind == kind]
            axis.loglog([r.cost for r in own], [r.numbers[column] for r in own], "o-", label=kind, markersize=4)
        for row, text in ((default, "default"), (best, "chosen")):
            if row:
                place = row.cost, row.numbers[column]
                axis.annotate(text, place, textcoords="offset points", xytext=(6, 6))
        axis.set_xlabel("us of a control step with gradient")
        axis.set_ylabel(label)
    figure.suptitle(title)
    figure.axes[0].legend(frameon=False, fontsize="small")
    with whole_file(path) as part:
        figure.savefig(part, dpi=150, format=path.suffix[1:])
    print(f"picture: {path}")

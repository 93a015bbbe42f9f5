"""What `diffsim tune` finds of every task: its presets among all settings, where integrators fail, and if it is right.

    python benchmarks/numerics.py                                  presets and extremes of all tasks
    python benchmarks/numerics.py ant --parts presets
    python benchmarks/numerics.py go2 examples/own_robot.xml --parts promise

Presets: all settings of a task, timed side by side on one thread. Extremes: the first value of each sweep with which an
integrator fails. Promise: the setting chosen for an error of 0.01, and its error on 200 states of other episodes.
Writes numerics_*.csv and a picture, and with --update-results the tables of docs/numerics.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import torch
import tyro
from common import TASKS, CommonFlags, Line, Panel, Part, Tasks, measured, plot, run
from tables import Cells, Row, grouped

import diffsim
from diffsim.sim.integration import Integration
from diffsim.tasks import Accuracy, find_task
from diffsim.training import Count
from diffsim_cli.tune import actor, subject
from diffsim_cli.tune.extremes import stress
from diffsim_cli.tune.front import Row as Measured
from diffsim_cli.tune.front import choice, finest, integrator, measure, settings
from diffsim_cli.tune.motion import SPANS, Motion

PartName = Literal["presets", "extremes", "promise"]
ERROR, OTHERS = 0.01, 200  # that is asked for, and states on which it is measured again
PROMISED = ("robot", "chosen", "error", "error on 200 others", "speed", "default's error")
SHOWN = {"speed": "speed", "state error (m, rad)": "state 0.5 s", "gradient error": "gradient 32"}
PRESETS = ("fast", "default")  # of a table: accurate has four times the substeps of default


@dataclass
class Args(CommonFlags):
    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = (*diffsim.TASKS,)  # tasks, my_task.py or robot.xml
    parts: tuple[PartName, ...] = ("presets", "extremes")  # tables to measure
    states: Count = 32  # start states
    env: tyro.conf.Suppress[Tasks] = TASKS

    @property
    def measured(self) -> Sequence[str]:
        return () if self.draw_only else self.robots


def motion_of(robot: str, states: int, seed: int = 0) -> Motion:
    task = subject(robot)
    env = diffsim.make(task, states, seed=seed, early_termination=False, max_episode_steps=2**31)
    return Motion(env, actor(robot, task, None)[0], seed)


def kind(how: Integration) -> str:
    """What it shares with those of other substeps."""
    return integrator(how) + (f" to {how.tolerance:g}" if how.contact == "mujoco" else "")


def named(how: Integration) -> str:
    return f"{kind(how)}, {how.substeps} substeps"


def measure_presets(args: Args, robot: str) -> Iterator[Row]:
    task, rows = subject(robot), list[Measured]()
    measure(motion_of(robot, args.states), settings(task, task.contact), rows, threads=1)
    for row in rows:
        yield {"task": task.name, "setting": named(row.how), "kind": kind(row.how), **row.numbers}


def labelled(rows: list[Cells]) -> list[Cells]:
    """The rows, by task, with the name of the preset that has this setting, and the speed relative to the default."""
    lines = list[Cells]()
    for (task,), own in grouped(rows, "task").items():
        names = {named(how): name for name, how in find_task(task).presets().items()}
        own = [row | {"preset": names.get(row["setting"], "")} for row in own]
        (default,) = (float(row["us with gradient"]) for row in own if row["preset"] == "default")
        lines += [row | {"speed": f"{default / float(row['us with gradient']):.2f}"} for row in own]
    return lines


def presets(rows: list[Cells]) -> list[Cells]:
    """A line for each preset, by task, the fastest first."""
    lines = sorted(
        (row for row in labelled(rows) if row["preset"]), key=lambda row: get_args(Accuracy).index(row["preset"])
    )
    lines = [row | {"setting": row["setting"].removesuffix(" substeps")} for row in lines]
    return [row for own in grouped(lines, "task").values() for row in own]


def shown(rows: list[Cells]) -> list[Row]:
    """A line for each task and preset: its integrator and substeps, the speed, and the errors of state and gradient."""
    lines = list[Row]()
    for row in (row for row in presets(rows) if row["preset"] in PRESETS):
        how, _, substeps = row["setting"].rpartition(", ")
        line = {"task": row["task"], "preset": row["preset"], "integrator": how, "substeps": substeps}
        lines.append(line | {title: row[name] for title, name in SHOWN.items()})
    return lines


def measure_extremes(args: Args, robot: str) -> Iterator[Row]:
    task = subject(robot)
    contacts, motion = dict.fromkeys((task.contact, "mujoco")), motion_of(robot, 8)
    for found in zip(*(stress(motion, task, contact) for contact in contacts), strict=True):
        yield {"task": task.name} | {name: cell for row in found for name, cell in row.items()}


def bounds(rows: list[Cells]) -> list[Row]:
    """Of each sweep and integrator: the mildest value with which a task fails, and how many do."""
    lines = list[Row]()
    for (sweep,), own in grouped(rows, "sweep").items():
        line: dict[str, object] = {"sweep": sweep}
        for kind in [name for name in own[0] if name not in ("task", "sweep")]:
            found = [row[kind] for row in own if row[kind]]
            failed = [float(cell.split(" ")[0]) for cell in found if cell != "-"]
            mildest = f"{(max if sweep == 'substeps' else min)(failed, default=0):g}"
            line[kind] = f"{mildest} ({len(failed)}/{len(found)})" if failed else "-"
        lines.append(line)
    return lines


def measure_promise(args: Args, robot: str) -> Iterator[Row]:
    task, rows = subject(robot), list[Measured]()
    found = settings(task, task.contact)
    measure(motion_of(robot, args.states), found, rows, threads=1)
    default = next(row for row in rows if row.how == task.integration("default"))
    best, others = choice(rows, ERROR), motion_of(robot, OTHERS, seed=1)
    assert best is not None, "no setting is good enough"
    again = others.error(others.replay(best.how), others.replay(finest(found), torch.float64), SPANS[-1])
    row: dict[str, object] = {"robot": Path(robot).stem}
    row |= {what: named(each.how).removesuffix(" substeps") for what, each in (("chosen", best), ("default", default))}
    row |= {"error": best.error, "error on 200 others": again, "times 0.01": again / ERROR}
    yield row | {"speed": default.cost / best.cost, "default's error": default.error}


def draw(args: Args, rows: list[Cells]) -> None:
    panels = list[Panel]()
    for (task,), own in grouped((row for row in labelled(rows) if "float64" not in row["kind"]), "task").items():
        lines = list[Line]()
        for k, ((kind,), same) in enumerate(grouped(own, "kind").items()):
            same = sorted(same, key=lambda row: float(row["us with gradient"]))
            x, y = ([float(row[name]) for row in same] for name in ("us with gradient", "state 0.5 s"))
            lines.append(Line(x, y, f"C{k}.-", kind, 0.8, [row["preset"] for row in same]))
        panels.append(Panel(lines, task, "us of a control step", "state error after 0.5 s (m, rad)", log="xy"))
    plot(args.picture("numerics"), [panels], (3.2, 2.8))


PAGE = "numerics.md"
PARTS: dict[PartName, Part] = {
    "presets": Part("numerics_presets", measure_presets, ("task", "setting"), "presets", PAGE, shown),
    "extremes": Part("numerics_extremes", measure_extremes, ("task", "sweep"), "extremes", shown=bounds),
    "promise": Part("numerics_promise", measure_promise, ("robot",), "promise", columns=PROMISED),
}


def main(args: Args) -> None:
    for name in args.parts:
        rows = measured(args, PARTS[name])
        if name == "presets":
            draw(args, rows)


if __name__ == "__main__":
    run(main, Args, __doc__)

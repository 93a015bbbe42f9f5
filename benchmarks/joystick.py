"""How well policies of the joystick tasks follow commands in MuJoCo, on any file of their robot.

    python benchmarks/joystick.py runs/go2__shac__1 --file path/to/unitree_go2/scene.xml
    python benchmarks/joystick.py runs/joystick/* --push 1 --latency 20 --mass 0.85 1.15 --gains 0.8 1.2

Each command is held for 20 s from the keyframe. The error of an episode is the mean distance of the velocity, averaged
over a second, from the command, after the first second. The joints are those of the same names; servos get the policy's
targets, and a motor the torque that the task's servo would have. Nothing else of the file is changed. The gait is that
at 0.5 m/s forward; the change of actions that of all commands.

Writes joystick.csv, a row for each policy and world, and with --update-results the tables of docs/joystick.md; with
--race joystick_race.csv, of checkpoints that were copied beside their run's progress.csv while it trained; with
--rough joystick_rough.csv, of ground of boxes, the same for all policies, on which each command starts elsewhere; with
--own joystick_own.csv.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

import common
import numpy as np
import tables
import torch
from common import ABOUT, Case, Part, load_case, measured, run
from tables import Row, grouped, middle, numbers
from worlds import Array, OtherFile, State, in_double, pushes, rollout

from diffsim.sim.elevation import Elevation
from diffsim.training import Positive, fail
from diffsim.training.checkpoint import HOME
from diffsim.training.ranges import Range
from diffsim_cli import gait
from diffsim_robots.joystick import Joystick
from diffsim_robots.terrain import STEEPEST, uneven

FORWARD, SIDEWAYS, TURNING = (-1.0, -0.5, 0.5, 1.0), (-0.5, 0.5), (-1.0, 1.0)
COMMANDS = [(0.0, 0.0, 0.0), *((v, 0.0, 0.0) for v in FORWARD), *((0.0, v, 0.0) for v in SIDEWAYS)]
COMMANDS += [(0.0, 0.0, w) for w in TURNING] + [(v, 0.0, w) for v in (0.5, -0.5) for w in TURNING]
WALK = COMMANDS.index((0.5, 0.0, 0.0))
RACE = (0.1, 0.05)  # m/s, errors to which learners race
PROFILE, STARTS, NEAR = 1_000_000, 4.0, 0.3  # seed of the rough ground; m, where commands start, and how long they are
PAGE = "joystick.md"
Slope = Annotated[float, Range(f"from 0 to {STEEPEST:g}", lambda degrees: 0 <= degrees <= STEEPEST)]
Long = Annotated[float, Range("at least 3", lambda seconds: seconds >= 3)]  # the first second does not count


@dataclass
class Args(common.ServoFlags):
    mass: tuple[Positive, ...] = (1.0,)  # of all bodies' mass and inertia
    gains: tuple[Positive, ...] = (1.0,)  # of the servos' stiffness and damping
    latency: Annotated[float, Range("from 0 to 40", lambda ms: 0 <= ms <= 40)] = 0.0  # ms by which actions come late
    seconds: Long = 20.0  # of an episode
    own: str | None = None  # FILE:CLASS of the policies' own task, whose code runs
    rough: tuple[Slope, ...] = ()  # degrees, steepest slopes of rough ground, 0: the file's plane


def follow(case: Case, world: OtherFile, args: Args, profile: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """The root's velocities (T, n, 3), vx and vy in its frame and its yaw rate, of each command; states before a step
    (T, n, nq), actions (T, n, nu), falls (n,)."""
    task, scene, n = in_double(case.env), case.env.scene, len(COMMANDS)
    late = args.latency / 1e3 / task.control_dt
    assert isinstance(task, Joystick)
    task.disturbances = {**task.disturbances, "latency": (late, late)}
    push = pushes(args.push, task.control_dt, np.random.default_rng(1))
    rest = torch.tensor(task.start).double().repeat(n, 1)  # the keyframe
    if profile is not None:  # above the highest ground near it
        task.ground = Elevation(scene.with_terrain(profile), "cpu", torch.float64)
        rest[:, 0] = torch.linspace(-STARTS, STARTS, n)
        rest[:, 2] += task.ground.at(rest[:, :1] + torch.linspace(-NEAR, NEAR, 25)).amax(1)
    memory = task.begin(rest.new_full((n, task.num_random), 0.5))
    memory[:, :3] = torch.tensor(COMMANDS)
    start = State(rest[:, : scene.nq], rest.new_zeros(n, scene.nv), rest.new_zeros(n, scene.nu), memory)
    steps = list(rollout(world, task, case.saved.network, start, round(args.seconds / task.control_dt), push))
    seen = torch.stack([step.obs[:, task.actor_dim :] for step in steps])  # the critic's part, without noise
    qpos, action = (torch.stack([getattr(step.state, name) for step in steps]).numpy() for name in ("qpos", "action"))
    return seen[..., [0, 1, 5]].numpy(), qpos[:-1], action[1:], steps[-1].fallen.numpy()


def errors(velocities: Array, second: int) -> Array:
    """(2, n) mean error of the velocity [m/s] and of the yaw rate [rad/s], averaged over a second, after the first."""
    sums = np.cumsum(velocities, axis=0)
    off = (sums[2 * second :] - sums[second:-second]) / second - np.array(COMMANDS)
    return np.stack((np.linalg.norm(off[..., :2], axis=-1).mean(0), np.abs(off[..., 2]).mean(0)))


def training(case: Case) -> dict[str, object]:
    """Which policy it is, where and how long it was trained, and its last evaluation's return, of what its run says."""
    about = case.about
    if case.saved.simulator != HOME:
        about["learner"] = f"{about['learner']} in {case.saved.simulator}"
    rows = tables.read_csv(case.path.parent / "progress.csv")
    rows = [row for row in rows if int(row["iteration"]) <= case.saved.iteration]
    device = str(case.saved.args.get("device", "")).partition(":")[0]
    about |= {"device": device, "return": ["", *numbers(rows, "eval_return")][-1]}
    return about | {"training s": float(rows[-1]["seconds"]) if rows else ""}


def measure(args: Args, path: Path) -> Iterator[Row]:
    """A row for each friction, mass and gains."""
    case = load_case(path, 1, "cpu", args.own)
    if not isinstance(task := case.env.task, Joystick):
        fail(f"{path} was trained on {task.name}, which follows no command")
    for slope, friction, mass, gains in product(args.rough or (0.0,), args.friction, args.mass, args.gains):
        profile = uneven(slope, 1, PROFILE)[0] if slope else None
        world = OtherFile(case.env, len(COMMANDS), args.file, friction, mass, gains, profile)
        velocities, qpos, action, fallen = follow(case, world, args, profile)
        error, yaw = errors(velocities, round(1 / task.control_dt))
        print("  " + "; ".join(f"{c} {e:.2f}" for c, e in zip(COMMANDS, error, strict=True)))
        row = {"file": args.file.parent.name if args.file else "", "friction": friction, "push": args.push}
        row |= {"mass": mass, "gains": gains, "latency": args.latency}
        row |= {"rough": slope} if args.rough else walk(case, qpos, action)
        row |= {"error": error.mean(), "worst error": error.max(), "yaw error": yaw.mean()}
        yield training(case) | row | {"whole": 1 - fallen.mean(), "seconds": args.seconds}


def walk(case: Case, qpos: Array, action: Array) -> dict[str, object]:
    """Gait at 0.5 m/s of qpos (T, n, nq) under action (T, n, nu): means over the feet, the lowest clearance; and how
    the actions of all commands change."""
    parts = gait.measure(case.env.scene, case.env.control_dt, [(qpos[:, WALK], action[:, WALK])])
    robot, feet = parts.pop("robot", {}), [*parts.values()]
    found: dict[str, object] = {name: robot.get(name, "") for name in ("left-right", "diagonal", "cost of transport")}
    found["clearance (m)"] = min((foot["clearance (m)"] for foot in feet), default="")
    for name in ("slip (m/s)", "duty"):
        found[name] = float(np.mean([foot[name] for foot in feet])) if feet else ""
    found["action change"] = float(np.sqrt(np.mean(np.diff(action, axis=0) ** 2)))
    return found | {"saturated": float(np.mean(np.abs(action) > gait.END))}


def worlds(row: dict[str, str]) -> list[str]:
    """What a row's world differs in from the file's; by its friction alone, nothing but this."""
    nominal = {"push": "pushes of {:g} m/s", "latency": "{:g} ms late", "mass": "mass x {:g}", "gains": "gains x {:g}"}
    found = [
        text.format(value)
        for name, text in nominal.items()
        if (value := float(row[name])) != (name in ("mass", "gains"))
    ]
    return found or [f"friction x {float(row['friction']):g}"]


def alone(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [row for row in rows if "_shared/" not in row["checkpoint"]]


Policy = tuple[str, str, str]  # task, learner and machine


def policies(rows: list[dict[str, str]]) -> dict[Policy, list[dict[str, str]]]:
    """The rows of each policy; of other files than the task's, if there are any."""
    rows = [row | {"by": learner(row)} for row in rows]
    rows = [row | {"on": row["checkpoint"].partition("/")[0].removesuffix("_shared")} for row in rows]
    rows.sort(key=lambda row: (row["task"], row["by"], row["on"]))
    rows = [row for row in rows if row["file"]] or rows
    return {(key[0], key[1], key[2]): group for key, group in grouped(rows, "task", "by", "on").items()}


def learner(row: dict[str, str]) -> str:
    """Shorten a checkpoint's learner: "ppo_baseline --symmetric" is PPO."""
    return row["learner"].partition(" ")[0].removesuffix("_baseline").upper()


def about(policy: Policy) -> dict[str, str]:
    task, by, on = policy
    return {"robot": task, "learner": by, "machine": {"cpu": "CPU"}.get(on, on.upper() if on[0] == "h" else on)}


def with_worst(rows: list[dict[str, str]], column: str, form: str, worst: Callable[[Sequence[float]], float]) -> str:
    """The median over seeds, in brackets the worst seed's."""
    values = numbers(rows, column)
    return f"{middle(rows, column, form)} ({worst(values):{form}})" if values else ""


def undisturbed(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [row for row in rows if worlds(row) == ["friction x 1"]]


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task, learner and machine: how well it follows commands in the file's world."""
    lines = list[Row]()
    for policy, group in policies(rows).items():
        plain = undisturbed(group)
        *first, machine = about(policy).items()
        line: dict[str, object] = {**dict(first), "seeds": len({row["checkpoint"] for row in group})}
        line |= {"training (s)": timed(plain, machine[1])}
        errors = {"error (m/s)": "error", "worst command (m/s)": "worst error", "yaw rate (rad/s)": "yaw error"}
        lines.append(line | {title: with_worst(plain, column, ".3f", max) for title, column in errors.items()})
    return lines


def timed(rows: list[dict[str, str]], machine: str) -> str:
    """The seconds of trainings that had the machine for themselves, and which it was."""
    seconds = middle(alone(rows), "training s", ".0f")
    return f"{seconds}, {machine}" if seconds else ""


def whole(rows: list[dict[str, str]]) -> list[Row]:
    """The share of episodes without a fall: a line for each task, learner and machine, a column for worlds that agree
    in all of them."""
    lines: dict[str, dict[Policy, str]] = {}
    for policy, group in policies(rows).items():
        kinds: dict[str, list[dict[str, str]]] = {}
        for row in group:
            kinds.setdefault(" and ".join(found) if len(found := worlds(row)) < 3 else "all", []).append(row)
        for kind, own in kinds.items():
            lines.setdefault(kind, {})[policy] = with_worst(own, "whole", ".0%", min)
    order = "friction", "pushes", "20", "mass", "gains", "all"
    agreeing: dict[tuple[str, ...], list[str]] = {}
    for kind in sorted(lines, key=lambda kind: [not kind.startswith(name) for name in order]):
        agreeing.setdefault(tuple(lines[kind].get(policy, "") for policy in policies(rows)), []).append(kind)
    return [
        about(policy) | {titled(kinds): cells[k] for cells, kinds in agreeing.items()}
        for k, policy in enumerate(policies(rows))
    ]


def titled(kinds: list[str]) -> str:
    """A column's title; the page lists the worlds if they are many."""
    return ", ".join(kinds) if len(kinds) < 4 else f"{len(kinds)} mild worlds"


def race(rows: list[dict[str, str]]) -> list[Row]:
    """Seconds of training to an error, from checkpoints along the way: a line for each task and learner, with all
    seeds."""
    lines = list[Row]()
    for (task, _), seeds in grouped(rows, "task", "learner").items():
        columns = dict[str, list[str]]()
        for group in grouped(seeds, "seed").values():
            group.sort(key=lambda row: float(row["training s"]))
            for most in RACE:
                good = (row["training s"] for row in group if float(row["error"]) <= most and float(row["whole"]) == 1)
                columns.setdefault(f"s to {most:g} m/s", []).append(next(good, "never"))
            columns.setdefault("in all (s)", []).append(group[-1]["training s"])
            columns.setdefault("last error (m/s)", []).append(group[-1]["error"])
        line = {name: ", ".join(cells) for name, cells in columns.items()}
        lines.append({"task": task, "learner": learner(seeds[0])} | line)
    return lines


def rough(rows: list[dict[str, str]]) -> list[Row]:
    """Who is whole on the steepest ground, and errors on each. A column for each task, learner and trained slope."""
    rows = [row | {"by": learner(row)} for row in rows]
    rows = [row | {"on": f"{row['learner'].partition(' rough ')[2] or 0}°"} for row in rows]
    columns = {", ".join(key): group for key, group in sorted(grouped(rows, "task", "by", "on").items())}
    slopes, lines = sorted({row["rough"] for row in rows}, key=float), list[Row]()
    for title, column, form, worst in (("whole", "whole", ".0%", min), ("error (m/s)", "error", ".3f", max)):
        for slope in slopes[-1:] if column == "whole" else slopes:
            line = {"ground": f"{title}, {slope}°"}
            for policy, group in columns.items():
                line[policy] = with_worst([row for row in group if row["rough"] == slope], column, form, worst)
            lines.append(line)
    return lines


def main(args: Args) -> None:
    key = (*ABOUT[:-1], "file", "friction", "push", "mass", "gains", "latency")
    if args.own:
        measured(args, Part("joystick_own", measure, key))
        return
    if args.race:
        measured(args, Part("joystick_race", measure, key, "race", PAGE, race))
        return
    if args.rough:
        measured(args, Part("joystick_rough", measure, (*key, "rough"), "rough", PAGE, rough))
        return
    rows = measured(args, Part("joystick", measure, key, "joystick", PAGE, table))
    args.publish("whole", tables.markdown(whole(rows)), PAGE)


if __name__ == "__main__":
    run(main, Args, __doc__)

"""How well policies of the joystick tasks follow commands, here and in MuJoCo on any file of their robot.

    python benchmarks/joystick.py runs/go2__shac__1 --file path/to/unitree_go2/scene.xml
    python benchmarks/joystick.py runs/joystick/* --push 0.5

Each command is held for 20 s from the keyframe. The error of an episode is the mean distance of the velocity, averaged
over a second, from the command, after the first second. In MuJoCo the joints are those of the same names; servos get
the policy's targets, and a motor the torque that the task's servo would have. Nothing else of the file is changed.

Writes joystick.csv, a row for each policy and world, and with --update-results the table of docs/joystick.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import common
import numpy as np
import tables
import torch
from common import ABOUT, Case, Part, load_case, measured, run
from groups import grouped, middle, numbers
from tables import Row
from worlds import Array, OtherFile, State, in_double, rollout

from diffsim.tasks.joystick import Joystick
from diffsim.training import NonNegative, Positive, fail
from diffsim.training.checkpoint import HOME

FORWARD, SIDEWAYS, TURNING = (-1.0, -0.5, 0.5, 1.0), (-0.5, 0.5), (-1.0, 1.0)
COMMANDS = [(0.0, 0.0, 0.0), *((v, 0.0, 0.0) for v in FORWARD), *((0.0, v, 0.0) for v in SIDEWAYS)]
COMMANDS += [(0.0, 0.0, w) for w in TURNING] + [(v, 0.0, w) for v in (0.5, -0.5) for w in TURNING]
KEY = (*ABOUT[:-1], "file", "friction", "push")


@dataclass
class Args(common.CheckpointFlags):
    file: Path | None = None  # MJCF of the robot with a ground, in place of the task's
    friction: tuple[Positive, ...] = (0.7, 1.0, 1.3)  # factors of the friction in MuJoCo
    push: NonNegative = 0.0  # m/s, a change of the root's velocity in a random direction every 4 s
    seconds: Positive = 20.0  # of an episode


def follow(case: Case, world: OtherFile, args: Args) -> tuple[Array, Array]:
    """The root's velocities (T, n, 3), vx and vy in its frame and its yaw rate, and falls (n,), of each command."""
    task, n = in_double(case.env), len(COMMANDS)
    every, drawn = round(4.0 / task.control_dt), np.random.default_rng(1)

    def push(step: int, state: State) -> State:
        if not args.push or not step or step % every:
            return state
        angles = drawn.uniform(0, 2 * np.pi, n)
        kicks = args.push * np.stack((np.cos(angles), np.sin(angles)), 1)
        return state._replace(qvel=state.qvel + torch.from_numpy(np.pad(kicks, ((0, 0), (0, case.env.scene.nv - 2)))))

    rest, scene = torch.tensor(task.start).double().expand(n, -1), case.env.scene  # the keyframe
    memory = task.begin(rest.new_full((n, task.num_random), 0.5))
    memory[:, :3] = torch.tensor(COMMANDS)
    start = State(rest[:, : scene.nq], rest.new_zeros(n, scene.nv), rest.new_zeros(n, scene.nu), memory)
    steps = list(rollout(world, task, case.saved.network, start, round(args.seconds / task.control_dt), push))
    seen = torch.stack([step.obs[:, task.actor_dim :] for step in steps])  # the critic's part, without noise
    return seen[..., [0, 1, 5]].numpy(), steps[-1].fallen.numpy()


def errors(velocities: Array, second: int) -> Array:
    """(n, 2) mean error of the velocity [m/s] and of the yaw rate [rad/s], averaged over a second, after the first."""
    sums = np.cumsum(velocities, axis=0)
    means = (sums[2 * second :] - sums[second:-second]) / second
    off = means - np.array(COMMANDS)
    return np.stack((np.linalg.norm(off[..., :2], axis=-1).mean(0), np.abs(off[..., 2]).mean(0)), axis=-1)


def training(case: Case) -> dict[str, object]:
    """Where the policy was trained, for how long, and its last evaluation's return, of what its run says."""
    rows = tables.read_csv(case.path.parent / "progress.csv")
    device = str(case.saved.args.get("device", "")).partition(":")[0]
    found: dict[str, object] = {"device": device, "return": ["", *numbers(rows, "eval_return")][-1]}
    return found | {"training s": float(rows[-1]["seconds"]) if rows else ""}


def measure(args: Args, path: Path) -> Iterator[Row]:
    """A row for each friction."""
    case = load_case(path, 1, "cpu")
    about = case.about
    if case.saved.simulator != HOME:
        about["learner"] = f"{about['learner']} in {case.saved.simulator}"
    if not isinstance(case.env.task, Joystick):
        fail(f"{path} was trained on {case.env.task.name}, which follows no command")
    for friction in args.friction:
        velocities, fallen = follow(case, OtherFile(case.env, len(COMMANDS), args.file, friction), args)
        found = errors(velocities, round(1 / case.env.task.control_dt))
        row = {"file": args.file.parent.name if args.file else "", "friction": friction, "push": args.push}
        row |= {"error": found[:, 0].mean(), "worst error": found[:, 0].max(), "yaw error": found[:, 1].mean()}
        print("  " + "; ".join(f"{c} {e:.2f}" for c, e in zip(COMMANDS, found[:, 0], strict=True)))
        yield about | training(case) | row | {"whole": 1 - fallen.mean(), "seconds": args.seconds}


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task, learner and machine, over seeds: medians, and the worst command of the worst seed."""
    rows = [row | {"machine": row["checkpoint"].partition("/")[0]} for row in rows]
    rows.sort(key=lambda row: (row["task"], row["checkpoint"]))
    lines = list[Row]()
    for (task, learner, machine, file), group in grouped(rows, "task", "learner", "machine", "file").items():
        calm = [row for row in group if float(row["push"]) == 0]
        plain = [row for row in calm if float(row["friction"]) == 1]
        if not plain:
            continue
        pushed = [float(row["whole"]) for row in group if float(row["push"]) > 0]
        lines.append(
            {"task": task, "learner": learner, "machine": machine, "seeds": len(plain)}
            | {"return": middle(plain, "return", ",.0f"), "training (s)": middle(plain, "training s", ".0f")}
            | {"judged on": file, "error (m/s)": middle(plain, "error", ".3f")}
            | {"worst command": f"{max(numbers(plain, 'worst error')):.2f}"}
            | {"yaw (rad/s)": middle(plain, "yaw error", ".2f"), "whole": f"{min(numbers(calm, 'whole')):.0%}"}
            | {"whole, pushed": f"{min(pushed):.0%}" if pushed else ""}
        )
    return lines


def main(args: Args) -> None:
    measured(args, Part("joystick", measure, KEY, "joystick", "joystick.md", table))


if __name__ == "__main__":
    run(main, Args, __doc__)

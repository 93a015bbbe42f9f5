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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import common
import mujoco
import numpy as np
import tables
import torch
from common import ABOUT, Case, Part, load_case, measured, run
from groups import grouped, middle, numbers
from numpy.typing import NDArray
from tables import Row

from diffsim.sim.launcher import available_cores
from diffsim.tasks.joystick import Joystick
from diffsim.training import NonNegative, Positive, fail
from diffsim.training.checkpoint import HOME

Array = NDArray[np.float64]
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


class Robot:
    """A robot in MuJoCo, driven as the task's; a file that lacks a joint or its actuator ends the benchmark."""

    def __init__(self, case: Case, file: Path | None, friction: float) -> None:
        self.task, own = case.env.task, case.env.scene.mj_model
        m = self.model = mujoco.MjModel.from_xml_path(str(file or case.env.scene.path))
        m.geom_friction[:, 0] *= friction
        m.pair_friction[:, :2] *= friction
        names = [own.joint(j).name for j in range(1, own.njnt)]
        at_joints = np.flatnonzero(m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        actuator = {m.joint(m.actuator_trnid[a, 0]).name: a for a in at_joints}
        if missing := [name for name in names if name not in actuator]:
            fail(f"{file}: no actuator of the joints {', '.join(missing)}")
        joints = np.array([m.joint(name).id for name in names])
        self.ctrl = np.array([actuator[name] for name in names])
        self.qpos, self.qvel = m.jnt_qposadr[joints], m.jnt_dofadr[joints]
        self.servo = m.actuator_biastype[self.ctrl] == mujoco.mjtBias.mjBIAS_AFFINE
        order = [own.actuator_trnid[:, 0].tolist().index(j) for j in range(1, own.njnt)]
        low, high = own.actuator_ctrlrange[order].T
        self.middle, self.half, self.order = (low + high) / 2, (high - low) / 2, order
        self.stiffness, self.damping = own.actuator_gainprm[order, 0], -own.actuator_biasprm[order, 2]
        # The file's passive damping of a motor's joint acts there, and so do its clamps.
        self.steps = max(1, round(self.task.control_dt / m.opt.timestep))
        self.least, self.most = m.actuator_ctrlrange[self.ctrl].T
        self.limited = m.actuator_ctrllimited[self.ctrl] != 0

    def start(self) -> mujoco.MjData:
        data, qpos = mujoco.MjData(self.model), np.array(self.task.start, np.float32)
        data.qpos[:7], data.qpos[self.qpos] = qpos[:7], qpos[7 : 7 + len(self.qpos)]
        mujoco.mj_forward(self.model, data)
        return data

    def step(self, data: mujoco.MjData, action: Array) -> None:
        target = self.middle + self.half * action[self.order]
        for _ in range(self.steps):
            torque = self.stiffness * (target - data.qpos[self.qpos]) - self.damping * data.qvel[self.qvel]
            ctrl = np.where(self.servo, target, torque)
            data.ctrl[self.ctrl] = np.where(self.limited, ctrl.clip(self.least, self.most), ctrl)
            mujoco.mj_step(self.model, data)

    def state(self, data: mujoco.MjData) -> tuple[Array, Array]:
        qpos = np.concatenate((data.qpos[:7], data.qpos[self.qpos]))
        return qpos, np.concatenate((data.qvel[:6], data.qvel[self.qvel]))


@torch.no_grad()
def follow(case: Case, robot: Robot, args: Args) -> tuple[Array, Array]:
    """The root's velocities (T, n, 3), vx and vy in its frame and its yaw rate, and falls (n,), of each command."""
    task, policy, n = case.env.task, case.saved.network, len(COMMANDS)
    commands, quiet = torch.tensor(COMMANDS), torch.full((n, task.num_noise), 0.5)  # sensors without noise
    memory = task.begin(torch.full((n, task.num_random), 0.5))
    action, fallen = torch.zeros(n, case.env.scene.nu), np.zeros(n, bool)
    data, generator, velocities = [robot.start() for _ in range(n)], np.random.default_rng(1), []
    with ThreadPoolExecutor(available_cores()) as pool:
        for t in range(round(args.seconds / task.control_dt)):
            memory[:, :3] = commands
            qpos, qvel = (np.stack(parts) for parts in zip(*map(robot.state, data), strict=True))
            obs = task.observe_with(torch.tensor(qpos).float(), torch.tensor(qvel).float(), action, memory)
            fallen |= task.terminated(obs).numpy() | ~np.isfinite(qpos).all(1)
            velocities.append(obs[:, task.actor_dim :][:, [0, 1, 5]].numpy())  # of the critic's part, without noise
            action = policy(obs).clamp(-1.0, 1.0)
            memory = task.remember(memory, action, quiet)
            if args.push and t and t % round(4.0 / task.control_dt) == 0:
                for each, angle in zip(data, generator.uniform(0, 2 * np.pi, n), strict=True):
                    each.qvel[:2] += args.push * np.array((np.cos(angle), np.sin(angle)))
            list(pool.map(robot.step, data, action.numpy().astype(float)))
    return np.stack(velocities), fallen


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
        velocities, fallen = follow(case, Robot(case, args.file, friction), args)
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

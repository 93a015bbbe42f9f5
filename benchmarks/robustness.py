"""What a policy's gait withstands: the smallest push that fells it, survival against impulse, and thrown cubes.

    python benchmarks/robustness.py runs/learning/shac/ant__1          a run, or a checkpoint of any learner's script
    python benchmarks/robustness.py runs/*/* --body torso --masses 5 10 20

Robots walk for 2 to 4 s, each for a time of its own, so that they are in any phase of their gait. Then each is pushed
at its trunk, or hit by a cube there, as in Table 1 and Figure 8 of the PFPN paper (Xu and Karamouzas 2021).
docs/robustness.md explains both tests. To fall is to end an episode of the task.

Writes robustness.csv, a row for each policy, and robustness_curves.csv, one for each push and cube; robustness.png; and
with --update-results the table of docs/robustness.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import common
import mujoco
import numpy as np
import torch
from common import ABOUT, Case, Panel, lines, load_case, plot, run
from groups import grouped
from tables import Row, markdown
from torch import Tensor
from worlds import Here, State, Step, rollout, starts

import diffsim
from diffsim import DiffEnv, Scene, Simulator
from diffsim.tasks import HumanoidImitation
from diffsim.training import Count, NonNegative, Positive, fail
from diffsim.training.evaluation import SEED

WALK = (2.0, 4.0)  # s before the push
PUSH = 0.1  # s
FORWARD, SIDEWAYS = "forward", "sideways"
DIRECTIONS = {FORWARD: (1.0, 0.0, 0.0), SIDEWAYS: (0.0, 1.0, 0.0)}
MULTIPLES = np.linspace(0.25, 2.0, 8)  # levels of the curves, in multiples of the smallest push
FIRST = 1 / 16  # the first push, as a share of the weight
MOST = 2**10  # the search ends at this multiple of the first push
TOLERANCE = 0.02  # relative error of the smallest push
KEY = ABOUT[:-1]
CURVE_KEY = (*KEY, "test", "level")  # level: of a push in multiples of the smallest, of a cube in kg
GROUP = ("task", "learner", "contact", "mass")  # columns in which the seeds of a table's row agree
EACH = ("seed", *(f"{way} {unit}" for unit in ("N", "m/s") for way in DIRECTIONS))  # which it has of each seed


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 64  # robots that begin to walk
    body: str = ""  # the pushed one, by its name in the MJCF (default: the robot's first)
    after: Positive = 3.0  # s from the beginning of the push in which a robot falls, or has survived
    masses: tuple[Positive, ...] = (1, 2, 5, 10, 20, 50, 100)  # masses of the cubes, kg
    speed: NonNegative = 0.2  # speed of the cubes, m/s
    restitution: NonNegative = 0.0  # 0: the cube stays with the trunk; 1: it bounces off


class Walkers:
    """Robots under their policy, which forces may push at a body; of env the task and the simulator are taken over."""

    def __init__(self, env: DiffEnv, policy: Callable[[Tensor], Tensor], body: int, start: State) -> None:
        self.task, self.policy, self.body, self.start, self.control_dt = env.task, policy, body, start, env.control_dt
        n, how = len(start.qpos), env.sim.integration
        self.sim = Simulator(env.scene, n, how, env.control_dt, device=env.device, dtype=env.dtype, forces=True)

    def steps(self, seconds: float) -> int:
        return max(1, round(seconds / self.control_dt))

    def walk(self, seconds: float, force: Tensor | None = None, pushed: int = 0) -> Iterator[Step]:
        """Control steps, in whose first ones a force (n, 3) acts."""

        def push(step: int, state: State) -> State:
            self.sim.forces[:, self.body, :3] = force if force is not None and step < pushed else 0.0
            return state

        return rollout(Here(self.sim), self.task, self.policy, self.start, self.steps(seconds), push)

    def endure(self, seconds: float, force: Tensor, pushed: int) -> Tensor:
        """(n,) control steps until each robot falls; all of them if it does not."""
        steps = torch.zeros(len(self.start.qpos), dtype=torch.long, device=self.sim.device)
        for step in self.walk(seconds, force, pushed):
            steps += ~step.fallen
            if step.fallen.all():
                break
        return steps


def walking(env: DiffEnv, policy: Callable[[Tensor], Tensor], body: int) -> State:
    """The states of the robots that still walk after a time, drawn for each, within WALK."""
    walkers = Walkers(env, policy, body, starts(env))
    first, last = map(walkers.steps, WALK)
    at = torch.randint(first, last + 1, (env.num_envs,), generator=torch.Generator().manual_seed(SEED)).to(env.device)
    found, standing = State(*(part.clone() for part in walkers.start)), torch.zeros_like(at, dtype=torch.bool)
    for count, step in enumerate(walkers.walk(WALK[1]), 1):
        now = at == count
        for part, new in zip(found, step.state, strict=True):
            part[now] = new[now]
        standing |= now & ~step.fallen
    return State(*(part[standing] for part in found))


def smallest(share: Callable[[float], float], first: float) -> float:
    """The least push, to TOLERANCE, that fells at least half, by the share that falls; infinite above MOST * first.

    If the share does not grow with the push everywhere, it is one place where it crosses a half.
    """
    low, high = 0.0, first
    while share(high) < 0.5:
        low, high = high, 2 * high
        if high > MOST * first:
            return math.inf
    while high - low > TOLERANCE * high:
        middle = (low + high) / 2
        low, high = (low, middle) if share(middle) >= 0.5 else (middle, high)
    return high


class Target(NamedTuple):
    """What a cube hits, of each of n robots: a body's centre, as it moves along x."""

    mass: np.ndarray  # (n,) kg that it shows to a push along x, 1 / (J M^-1 J')
    velocity: np.ndarray  # (n,) m/s


def target(scene: Scene, state: State, body: int) -> Target:
    """By MuJoCo's Jacobian J and mass matrix M."""
    model, found = scene.mj_model, list[tuple[float, float]]()
    data, jacobian, solved = mujoco.MjData(model), np.zeros((3, model.nv)), np.zeros((1, model.nv))
    for qpos, qvel in zip(*(part.double().numpy(force=True) for part in state[:2]), strict=True):
        data.qpos = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        mujoco.mj_solveM(model, data, solved, jacobian[:1])
        found.append((1 / (solved[0] @ jacobian[0]), jacobian[0] @ qvel))
    return Target(*np.array(found).T)


def impulse(hit: Target, mass: float, speed: float, restitution: float) -> np.ndarray:
    """(n,) N s along x, of a cube that comes from the front at a speed; 0 on who is faster backwards."""
    closing = np.maximum(hit.velocity + speed, 0.0)
    return -(1 + restitution) * closing * mass * hit.mass / (mass + hit.mass)


def load(path: Path, args: Args) -> tuple[Case, int]:
    """The policy and the body to push; what cannot be pushed over ends the benchmark with one line."""
    case = load_case(path, args.num_envs, args.device)
    scene, name = case.env.scene, case.env.task.name
    if "contact" not in scene.features:
        fail(f"{case.path} was trained on {name}, which stands on no ground")
    if not case.env.task.falls():
        fail(f"{case.path} was trained on {name}, whose episodes do not end with a fall")
    if isinstance(case.env.task, HumanoidImitation) and not case.env.task.clip.loop:
        fail(f"{case.path} tracks a motion that ends, and with it the episode: train with a loop")
    body = mujoco.mj_name2id(scene.mj_model, mujoco.mjtObj.mjOBJ_BODY, args.body) if args.body else 1
    if body < 1:
        names = ", ".join(scene.mj_model.body(k).name for k in range(1, scene.nbody))
        fail(f"--body: the robot has no {args.body!r}; choose from {names}")
    return case, body


def measure(case: Case, body: int, args: Args) -> None:
    """Both tests of one policy; the csv files have each push as soon as it is measured."""
    env, scene = case.env, case.env.scene
    policy = case.saved.network.to(env.device)
    state = walking(env, policy, body)
    count, mass = len(state.qpos), float(scene.mass.sum())
    if 2 * count < env.num_envs:
        fail(f"only {count} of {env.num_envs} walk for {WALK[0]:g} to {WALK[1]:g} s without a push")
    walkers = Walkers(env, policy, body, state)
    limit, push = walkers.steps(args.after), walkers.steps(PUSH)
    second = push * env.control_dt  # s, nearly PUSH

    def fallen(direction: str, newtons: float) -> float:
        force = newtons * torch.tensor(DIRECTIONS[direction], dtype=env.dtype, device=env.device)
        return float((walkers.endure(args.after, force.expand(count, 3), push) < limit).double().mean())

    about = case.about | {"body": scene.mj_model.body(body).name, "after": args.after}
    unpushed = fallen(FORWARD, 0.0)
    if unpushed >= 0.5:
        fail(f"{unpushed:.0%} fall without a push")
    row = about | {"robots": count, "unpushed": unpushed, "mass": mass}
    for direction in DIRECTIONS if scene.floating else (FORWARD,):  # what is planar does not feel the other
        least = smallest(partial(fallen, direction), FIRST * 9.81 * mass)
        row |= {f"{direction} N": least, f"{direction} m/s": least * second / mass}
        for multiple in map(float, MULTIPLES if math.isfinite(least) else ()):
            kick = multiple * least * second
            level = {"test": direction, "level": multiple, "impulse": kick, "m/s": kick / mass}
            level["survived"] = 1 - fallen(direction, multiple * least)
            args.keep("robustness_curves", about | level, CURVE_KEY)
    args.keep("robustness", row, KEY)

    hit = target(scene, state, body)
    for kilograms in args.masses:
        kicks = impulse(hit, kilograms, args.speed, args.restitution)
        force = torch.zeros(count, 3, dtype=env.dtype, device=env.device)
        force[:, 0] = torch.as_tensor(kicks / env.control_dt)
        steps, kick = walkers.endure(args.after, force, 1).double(), float(-kicks.mean())
        level = {"test": "cube", "level": kilograms, "impulse": kick, "m/s": kick / mass}
        level |= {"survived": float((steps == limit).double().mean()), "steps": float(steps.mean())}
        level |= {"steps sd": float(steps.std()), "speed": args.speed, "restitution": args.restitution}
        args.keep("robustness_curves", about | level, CURVE_KEY)


def panels(rows: list[dict[str, str]]) -> list[Panel]:
    """Survival against the impulse of pushes, and control steps until the fall against the mass of cubes."""
    own = {test: [row for row in rows if row["test"] == test] for test in (*DIRECTIONS, "cube")}
    pushes = {test: lines(own[test], "m/s", "survived", "checkpoint") for test in DIRECTIONS}
    cubes = lines(own["cube"], "level", "steps", "checkpoint")
    return [
        *(Panel(curves, test, "impulse per mass (N s/kg)", "share upright") for test, curves in pushes.items()),
        Panel(cubes, "cube", "its mass (kg)", "control steps until the fall", log="x", zero=True),
    ]


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each learner on a task: each seed's smallest pushes, and the change of speed that they would cause."""
    tasks = [*diffsim.TASKS, *(row["task"] for row in rows)]
    rows = sorted(rows, key=lambda row: (tasks.index(row["task"]), row["checkpoint"]))
    each = {
        group: {name: ", ".join(row.get(name, "") for row in seeds) for name in EACH}
        for group, seeds in grouped(rows, *GROUP).items()
    }
    return [dict(zip(GROUP, group, strict=True)) | cells for group, cells in each.items()]


def main(args: Args) -> None:
    for case, body in [load(path, args) for path in args.measured]:
        print(f"{case.label}: {case.env.task.name}, {case.saved.script}.py", flush=True)
        measure(case, body, args)
    if rows := args.read("robustness_curves"):
        plot(args.picture("robustness"), [panels(rows)], (3.8, 3.2))
    args.publish("robustness", markdown(table(args.read("robustness"))), "robustness.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

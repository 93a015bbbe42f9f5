"""What a policy's gait withstands: the smallest push that fells it.

    python benchmarks/robustness.py runs/learning/shac/ant__1          a run, or a checkpoint of any learner's script

Robots walk for 2 to 4 s, each for a time of its own, so that they are in any phase of their gait. Then each is pushed
at its trunk, as in Table 1 of the PFPN paper (Xu and Karamouzas 2021). To fall is to end an episode of the task.

Writes robustness.csv, a row for each policy. docs/pfpn.md quotes means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import common
import torch
from common import ABOUT, Case, Part, load_case, measured, run
from tables import Row
from torch import Tensor
from worlds import Here, State, Step, rollout, starts

from diffsim import DiffEnv, Simulator
from diffsim.training import Count, fail
from diffsim.training.evaluation import SEED
from diffsim_robots.imitation.task import HumanoidImitation

WALK = (2.0, 4.0)  # s before the push
PUSH = 0.1  # s
DIRECTIONS = {"forward": (1.0, 0.0, 0.0), "sideways": (0.0, 1.0, 0.0)}
FIRST = 1 / 16  # the first push, as a share of the weight
MOST = 2**10  # the search ends at this multiple of the first push
TOLERANCE = 0.02  # relative error of the smallest push
AFTER = 3.0  # s from the beginning of the push in which a robot falls, or has survived
TRUNK = 1  # the pushed body: the robot's first


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 64  # robots that begin to walk
    own: str | None = None  # FILE:CLASS of the policies' own task, whose code runs


class Walkers(NamedTuple):
    """Robots under their policy, which forces may push at the trunk; env gives the task and the simulator."""

    env: DiffEnv
    policy: Callable[[Tensor], Tensor]
    start: State

    def steps(self, seconds: float) -> int:
        return max(1, round(seconds / self.env.control_dt))

    def walk(self, seconds: float, force: Tensor | None = None) -> Iterator[Step]:
        """Control steps; in the first ones, for PUSH, a force (n, 3) acts."""
        env, pushed = self.env, self.steps(PUSH)
        placed = env.sim.options._replace(factors=False, forces=True)
        sim = Simulator(env.scene, len(self.start.qpos), control_dt=env.control_dt, **placed._asdict())

        def push(step: int, state: State) -> State:
            sim.forces[:, TRUNK, :3] = force if force is not None and step < pushed else 0.0
            return state

        return rollout(Here(sim), env.task, self.policy, self.start, self.steps(seconds), push)

    def felled(self, seconds: float, direction: str, newtons: float) -> Tensor:
        """(n,) who falls in that time from a push on."""
        force = newtons * torch.tensor(DIRECTIONS[direction]).to(self.start.qpos).expand(len(self.start.qpos), 3)
        for step in self.walk(seconds, force):
            if step.fallen.all():
                break
        return step.fallen


def walking(env: DiffEnv, policy: Callable[[Tensor], Tensor]) -> Walkers:
    """The robots that still walk after a time, drawn for each, within WALK."""
    walkers = Walkers(env, policy, starts(env))
    first, last = map(walkers.steps, WALK)
    at = torch.randint(first, last + 1, (env.num_envs,), generator=torch.Generator().manual_seed(SEED)).to(env.device)
    found, standing = State(*(part.clone() for part in walkers.start)), torch.zeros_like(at, dtype=torch.bool)
    for count, step in enumerate(walkers.walk(WALK[1]), 1):
        now = at == count
        for part, new in zip(found, step.state, strict=True):
            part[now] = new[now]
        standing |= now & ~step.fallen
    return walkers._replace(start=State(*(part[standing] for part in found)))


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


def load(args: Args, path: Path) -> Case:
    """The policy; one that cannot be pushed over ends the benchmark with one line."""
    case = load_case(path, args.num_envs, args.device, args.own)
    if not case.env.task.falls():
        fail(f"{case.path} was trained on {case.env.task.name}, whose episodes do not end with a fall")
    if isinstance(case.env.task, HumanoidImitation) and not case.env.task.clip.loop:
        fail(f"{case.path} tracks a motion that ends, and with it the episode: train with a loop")
    return case


def measure(args: Args, path: Path) -> Iterator[Row]:
    case = load(args, path)
    env, scene, mass = case.env, case.env.scene, float(case.env.scene.mass.sum())
    walkers = walking(env, case.saved.network.to(env.device))
    if 2 * (count := len(walkers.start.qpos)) < env.num_envs:
        fail(f"only {count} of {env.num_envs} walk for {WALK[0]:g} to {WALK[1]:g} s without a push")

    def fallen(direction: str, newtons: float) -> float:
        return float(walkers.felled(AFTER, direction, newtons).double().mean())

    if (unpushed := fallen("forward", 0.0)) >= 0.5:
        fail(f"{unpushed:.0%} fall without a push")
    row = case.about | {"robots": count, "unpushed": unpushed, "mass": mass}
    for direction in DIRECTIONS if scene.floating else ("forward",):  # what is planar does not feel the other
        row[f"{direction} N"] = smallest(partial(fallen, direction), FIRST * 9.81 * mass)
    yield row


def main(args: Args) -> None:
    measured(args, Part("robustness", measure, ABOUT[:-1]))


if __name__ == "__main__":
    run(main, Args, __doc__)

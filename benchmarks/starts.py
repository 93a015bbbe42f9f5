"""Planning from many starts at once: how long an iteration of iLQR takes, and whether more starts find better plans.

    python benchmarks/starts.py --iterations 20                     cartpole, hopper, walker from 1, 4, 16 and 64 starts
    python benchmarks/starts.py --iterations 20 --device cuda       on a GPU

A start is a random action sequence from the task's start state; a smaller number takes the first ones of a larger. All
are optimised side by side, by gps.py's cost, on a CPU by one thread. Writes starts.csv.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from statistics import median
from typing import Literal, get_args

import torch
import tyro
from common import CommonFlags, Tasks, parse
from tables import ROOT, Row, digits

import diffsim
from diffsim.planning import ilqr, starting_actions
from diffsim.training import Count, command

sys.path.append(str(ROOT))
import gps  # noqa: E402

Robot = Literal["cartpole", "hopper", "walker"]
STEPS: dict[Robot, int] = {"cartpole": 240, "hopper": 100, "walker": 100}
KEY = ("task", "T", "starts", "iterations", "seed")


@dataclass
class Args(CommonFlags):
    env: tyro.conf.Suppress[Tasks] = ()
    robots: tuple[Robot, ...] = get_args(Robot)  # that plan
    starts: tuple[Count, ...] = (1, 4, 16, 64)  # at once
    iterations: Count = 30  # of iLQR
    seed: int = 1  # of the random starts


def measure(args: Args, robot: Robot, starts: int) -> Row:
    """Seconds of an iteration and the costs in the end, of so many starts; those that diverge are left out."""
    T, flags = STEPS[robot], ["--env", robot, "--device", args.device, "--threads", "1"]
    search = gps.Search(gps.parse(gps.Args, [*flags, "--horizon", str(T)]), diffsim.make(robot, 1, device=args.device))
    system, rng = search.system, torch.Generator().manual_seed(args.seed)
    u = starting_actions(starts, T, system.nu, system.control_dt, rng).to(system.device)
    x, u, finite = system.rollout(system.start().expand(starts, -1), T, lambda t, _: u[:, t])
    x, u = x[finite.all(1)], u[finite.all(1)]
    ilqr(system, search.cost, x, u, 1)  # compiles the kernels
    # Of a CPU the process's own time, to which other programs on the cores add nothing: it has one thread.
    clock = time.process_time if args.device == "cpu" else time.perf_counter
    before, times = system.steps, [clock()]

    def show(iteration: int, costs: torch.Tensor) -> None:
        costs.sum().item()  # waits for the device
        times.append(clock())

    costs = ilqr(system, search.cost, x, u, args.iterations, show=show).cost.tolist()
    seconds, done = times[-1] - times[0], len(times) - 1
    case = dict(task=robot, T=T, starts=starts, iterations=args.iterations, seed=args.seed)
    speed = dict(seconds=seconds / done, ms_per_start=1e3 * seconds / done / len(x))
    speed["steps_per_second"] = (system.steps - before) / seconds
    return case | dict(finite=len(x), done=done) | speed | dict(best=min(costs), median=median(costs))


def main(args: Args) -> None:
    for robot in () if args.draw_only else args.robots:
        for starts in args.starts:
            row = measure(args, robot, starts)
            print("  " + ", ".join(f"{column} {digits(value)}" for column, value in row.items()), flush=True)
            args.merge("starts", [row], KEY)


if __name__ == "__main__":
    command(lambda: main(parse(Args, __doc__)))()

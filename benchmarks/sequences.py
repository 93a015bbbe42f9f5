"""How far each order of PODS improves action sequences alone, without a policy: where the line search ends.

    python benchmarks/sequences.py                      cartpole, from no action and from random ones; minutes

Writes pods_sequences.csv and, with --update-results, the table of docs/pods.md. All sequences start in states of the
training distribution. The random actions are those from which the planner restarts.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import common
import torch
from common import TaskName, measured, parse
from tables import Row, markdown

import diffsim
import pods
from diffsim.planning import REAL, starting_actions
from diffsim.training import Count

MARKS = (1, 10, 40)  # improvements after which the returns are noted


@dataclass
class Args(common.CommonFlags):
    env: common.Tasks = ("cartpole",)  # tasks
    sequences: Count = 16  # side by side
    seed: int = 0  # of their start states and actions


def measure(args: Args, env: TaskName) -> Iterator[Row]:
    for order, (start, kind) in itertools.product((1, 2), enumerate(("no action", "random"))):
        words = f"--env {env} --order {order} --num-envs {args.sequences} --improvements 1 --device {args.device}"
        flags = pods.parse(pods.Args, [*words.split(), "--threads", "1"])
        world = diffsim.make(env, args.sequences, args.device, args.seed, flags.horizon, threads=1)
        learner = pods.PODS(flags, world)
        state = pods.Start(world.qpos, world.qvel, world.detach())
        generator = torch.Generator().manual_seed(args.seed)
        actions = starting_actions(args.sequences + 1, flags.horizon, world.scene.nu, world.control_dt, generator)
        u = (start * actions[1:]).transpose(0, 1).to(world.device, torch.float32)
        done = 0
        for mark in MARKS:
            if order == 1:
                for _ in range(mark - done):
                    _, new = pods.steepest_ascent(world.sim, learner.trials, world.task, state, u, learner.sizes)
                    u = new.u
                learner.control_steps += (mark - done) * u[..., 0].numel() * (1 + flags.candidates)
            else:
                flags.improvements = mark - done
                _, new = learner.plan(state, u)
                u = new.u
            done = mark
            returns = new.returns.to(REAL)
            yield {
                "task": env,
                "order": order,
                "start": kind,
                "improvements": mark,
                "sequences": args.sequences,
                "mean": f"{returns.mean():.0f}",
                "best": f"{returns.max():.0f}",
                "worst": f"{returns.min():.0f}",
                "control steps": f"{learner.control_steps / 1e6:.3g} M",
            }


def main(args: Args) -> None:
    rows = measured(args, "pods_sequences", measure, ("task", "order", "start", "improvements"))
    args.publish("sequences", markdown(rows, [name for name in rows[0] if name != "task"]), "pods.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))

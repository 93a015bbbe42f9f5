"""How well policies of examples with contact between bodies reach their aim in MuJoCo, on any file of their robot.

    python benchmarks/own_tasks.py runs/get_up__rpo__1 --own examples/get_up.py --file path/to/unitree_g1/scene.xml
    python benchmarks/own_tasks.py runs/cassie__rpo__1 --own examples/cassie.py --update-results

A task's `achieved` tells whether a state is the aim; its `error` is a vector by which a state misses what the policy
follows. That of an episode is the length of its mean over the second half, in which the swing of a gait cancels.

Episodes begin as in training, without a robot that is lighter. The file's own collisions, friction and timestep act.
What the task adds, servos and a ball, is added to the file.

Writes own_tasks.csv, a row for each policy and file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import mujoco
import numpy as np
import torch
from common import ABOUT, Part, load_case, measured, run
from joystick import training
from tables import Row
from worlds import MuJoCo, State, Step, in_double, rollout

from diffsim import load_scene
from diffsim.training import Count, fail
from diffsim.training.evaluation import SEED


@dataclass
class Args(common.CheckpointFlags):
    own: str = "examples/get_up.py"  # FILE:CLASS of the policies' task, whose code runs
    file: Path | None = None  # MJCF of the robot with a ground, in place of the task's
    episodes: Count = 64


def measure(args: Args, path: Path) -> Iterator[Row]:
    """The only row: how well the aim is reached or followed, the share of episodes that fall, how actions change."""
    case = load_case(path, 1, "cpu", args.own)
    if args.file and not args.file.is_file():
        fail(f"no such file: {args.file}; MuJoCo Menagerie is at github.com/google-deepmind/mujoco_menagerie")
    task: Any = in_double(case.env)
    if not (hasattr(task, "achieved") or hasattr(task, "error")):
        fail(f"{args.own} does not say what its policies should achieve")
    if args.file and not hasattr(task, "prepare"):
        fail(f"{args.own} has no `prepare`, which puts on --file what the task adds")
    scene = load_scene(task.prepare(mujoco.MjSpec.from_file(str(args.file)))) if args.file else case.env.scene
    n, drawn = args.episodes, torch.Generator().manual_seed(SEED)
    rand = torch.rand(n, task.num_random, generator=drawn, dtype=torch.float64)
    rand = task.for_test(rand) if hasattr(task, "for_test") else rand
    qpos, qvel = task.reset(rand)
    start = State(qpos, qvel, rand.new_zeros(n, scene.nu), task.begin(rand))
    world = MuJoCo(scene, n, task.control_dt, own_friction=True)
    steps = list(rollout(world, task, case.saved.network, start, task.episode_length))
    change = torch.stack([b.state.action - a.state.action for a, b in zip(steps, steps[1:], strict=False)])
    yield training(case) | {
        "file": args.file.parent.name if args.file else "",
        **(aim(task, steps) if hasattr(task, "achieved") else {}),
        **(errors(task, steps) if hasattr(task, "error") else {}),
        "fallen": steps[-1].fallen.double().mean().item(),
        "action change": change.abs().mean().item(),
        "episodes": n,
    }


def aim(task: Any, steps: list[Step]) -> Row:
    """Shares of episodes that reach the aim and are there at the end; seconds until the aim."""
    there = torch.stack([task.achieved(step.state.qpos, step.state.memory) for step in steps]).numpy()
    reached = there.any(0)
    seconds = task.control_dt * (1 + there.argmax(0))[reached]
    return {
        "reached": reached.mean(),
        "seconds": np.median(seconds) if reached.any() else "",
        "slowest": seconds.max() if reached.any() else "",
        "at the end": there[-1].mean(),
    }


def errors(task: Any, steps: list[Step]) -> Row:
    """The median and the largest error of episodes without a fall."""
    late = [task.error(*step.state[:2], step.state.memory) for step in steps[len(steps) // 2 :]]
    found = torch.stack(late).mean(0).norm(dim=-1)[~steps[-1].fallen].numpy()
    return {"error": np.median(found) if len(found) else "", "worst error": found.max() if len(found) else ""}


def main(args: Args) -> None:
    measured(args, Part("own_tasks", measure, (*ABOUT[:-1], "file")))


if __name__ == "__main__":
    run(main, Args, __doc__)

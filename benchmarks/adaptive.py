"""What substeps that adapt to contact could win at most: how coarse may a control step without contact be?

    python benchmarks/adaptive.py --env hopper ant

A trained policy acts in a fine float64 simulation. Its control steps are sorted into those that touch the ground at one
of 16 instants and those that do not, and each is taken again, by itself, with fewer explicit substeps. Steps in flight
may have as few as keep their error (95th percentile over steps, of the root mean square over degrees of freedom, m and
rad) at or below that of the steps in contact at the default's substeps. The gain is the default's substeps over the
average that is left, for an environment that knows beforehand when it will touch, and pays nothing for it.

Writes benchmarks/results/adaptive.csv and the table of docs/accuracy.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from common import DOCS, RESULTS, RUNS, load_policy, visited_states
from tables import fill, markdown, merge_csv
from torch import Tensor
from tradeoff import CONTROL_DT, deepest, simulator, state_errors

import diffsim
from diffsim import Integration
from diffsim.run import fail

INSTANTS = 16  # of a control step at which contact is looked for


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = (
        "hopper",
        "half_cheetah",
        "ant",
        "humanoid",
        "humanoid_mtu",
    )
    """tasks"""
    checkpoint: Path | None = None
    """checkpoint of shac.py whose policy acts; None: each task's in --runs, else untrained"""
    runs: Path = RUNS
    """directory of the runs of benchmarks/learning.py"""
    states: int = 32
    """episodes"""
    steps: int = 60
    """control steps of each"""
    output: Path = RESULTS
    """directory of the table"""


@torch.no_grad()
def motion(args: Args, name: str) -> tuple[Any, list[Tensor], Tensor, np.ndarray]:
    """Of the policy's control steps: scene, starts (qpos, qvel, action), ends, and which touch the ground."""
    task, scene = diffsim.TASKS[name](dtype=torch.float64), diffsim.make(name, num_envs=1).scene
    policy, called = load_policy(name, args.checkpoint, args.runs)
    qpos, qvel = visited_states(name, policy, args.states)
    integration = task.integration("default")
    sim = diffsim.Simulator(scene, args.states, integration, CONTROL_DT / INSTANTS, dtype=torch.float64)
    starts, ends, touching = [], [], []
    action = torch.zeros(args.states, scene.nu, dtype=torch.float64)
    for _ in range(args.steps):
        action = policy(task.observe(qpos, qvel, action)).clamp(-1, 1)
        starts.append((qpos, qvel, action))
        instants = [qpos]
        for _ in range(INSTANTS):
            qpos, qvel = sim.step(qpos, qvel, action)
            instants.append(qpos)
        ends.append(qpos)
        touching.append(deepest(scene.mj_model, torch.stack(instants)) > 0)
    print(f"{name}: {called}, {args.states} episodes of {args.steps} control steps", flush=True)
    return scene, [torch.cat(x) for x in zip(*starts, strict=True)], torch.cat(ends), np.concatenate(touching)


def measure(args: Args, name: str) -> dict[str, Any]:
    scene, starts, ends, touching = motion(args, name)
    default = diffsim.TASKS[name].substeps
    row: dict[str, Any] = {"task": name, "steps in flight": f"{1 - touching.mean():.3f}"}
    if touching.all() or not touching.any():
        return row  # nothing to compare
    quantiles = {}
    for substeps in [n for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 48) if n <= default]:
        sim = simulator(scene, Integration("semi_implicit", substeps), torch.float64, len(ends))
        with torch.no_grad():
            found = state_errors(scene.mj_model, sim.step(*starts)[0], ends)
        quantiles[substeps] = [float(np.quantile(found[kind], 0.95)) for kind in (touching, ~touching)]
    allowed = quantiles[default][0]
    least = next(n for n in quantiles if all(quantiles[m][1] <= allowed for m in quantiles if m >= n) or n == default)
    left = touching.mean() * default + (1 - touching.mean()) * least
    row |= {"error in contact, default": allowed, "error in flight, default": quantiles[default][1]}
    row |= {"default substeps": default, "in flight": least, "error in flight": quantiles[least][1]}
    return row | {"gain": f"{default / left:.2f}"}


def main(args: Args) -> None:
    if unknown := [name for name in args.env if name not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    rows = merge_csv(args.output / "adaptive.csv", [measure(args, name) for name in args.env], ("task",))
    if args.output == RESULTS:
        fill(DOCS / "accuracy.md", "adaptive", markdown(rows))
    print(markdown(rows), end="")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

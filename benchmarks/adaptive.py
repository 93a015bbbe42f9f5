"""What substeps that adapt to contact could win at most: how coarse may a control step without contact be?

    python benchmarks/adaptive.py --env hopper ant

A trained policy acts in a fine float64 simulation. Its control steps are sorted into those that touch the ground at one
of 16 instants and those that do not, and each is taken again, by itself, with fewer explicit substeps. Steps in flight
may have as few as keep their error (95th percentile over steps, of the root mean square over degrees of freedom, m and
rad) at or below that of the steps in contact at the default's substeps. The gain is the default's substeps over the
average that is left, for an environment that knows beforehand when it will touch, and pays nothing for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from common import TASKS, TaskName, Tasks, measured, parse
from motions import CONTROL_DT, Array, Case, PolicyFlags, deepest, integration, simulator, state_errors
from tables import Row, markdown
from torch import Tensor

from diffsim.training import Count

INSTANTS = 16  # of a control step at which contact is looked for


@dataclass
class Args(PolicyFlags):
    env: Tasks = TASKS[1:]  # tasks, on a ground
    steps: Count = 60  # control steps of each episode, of which there are --states


class Motion(NamedTuple):
    """Control steps of the policy."""

    starts: tuple[Tensor, Tensor, Tensor]  # qpos, qvel, action
    ends: Tensor  # qpos
    touching: Array  # which meet the ground


def motion(case: Case, steps: int) -> Motion:
    qpos, qvel, action = case.qpos, case.qvel, torch.zeros(case.n, case.scene.nu, dtype=torch.float64)
    fine = integration("semi_implicit", case.task.substeps)
    sim = simulator(case.scene, fine, case.n, torch.float64, control_dt=CONTROL_DT / INSTANTS)
    starts, ends, touching = [], [], []
    for _ in range(steps):
        action = case.policy(case.task.observe(qpos, qvel, action)).clamp(-1, 1)
        starts.append((qpos, qvel, action))
        instants = [qpos]
        for _ in range(INSTANTS):
            qpos, qvel = sim.step(qpos, qvel, action)
            instants.append(qpos)
        ends.append(qpos)
        touching.append(deepest(case.scene.mj_model, torch.stack(instants)) > 0)
    q, v, ctrl = (torch.cat(x) for x in zip(*starts, strict=True))
    return Motion((q, v, ctrl), torch.cat(ends), np.concatenate(touching))


@torch.no_grad()
def measure(args: Args, name: TaskName) -> Iterator[Row]:
    case = Case(args, name)
    starts, ends, touching = motion(case, args.steps)
    row: dict[str, object] = {"task": name, "steps in flight": f"{1 - touching.mean():.3f}"}
    if not touching.all() and touching.any():  # there is something to compare
        default, quantiles = case.task.substeps, dict[int, list[float]]()
        for substeps in [n for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 48) if n <= default]:
            sim = simulator(case.scene, integration("semi_implicit", substeps), len(ends), torch.float64)
            found = state_errors(case.scene.mj_model, sim.step(*starts)[0], ends)
            quantiles[substeps] = [float(np.quantile(found[kind], 0.95)) for kind in (touching, ~touching)]
        contact, flight = quantiles[default]
        good = [n for n in quantiles if all(quantiles[m][1] <= contact for m in quantiles if m >= n)]
        least = min([*good, default])
        left = touching.mean() * default + (1 - touching.mean()) * least
        row |= {"error in contact, default": contact, "error in flight, default": flight, "default substeps": default}
        row |= {"in flight": least, "error in flight": quantiles[least][1], "gain": f"{default / left:.2f}"}
    yield row


if __name__ == "__main__":
    args = parse(Args, __doc__)
    args.publish("adaptive", markdown(measured(args, "adaptive", measure, ("task",))), {"cpu": "accuracy.md"})

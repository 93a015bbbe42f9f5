"""How long a robot of guided policy search runs, beside its guides: with noise, pushed off its start, on rough ground.

    python benchmarks/gps_humanoid.py runs/gps/humanoid__spread-3__1 runs/gps/humanoid__spread-30__1

Figure 5 of the paper, of runs of gps.py in folders TASK__CASE__SEED. The policy, the DDP controller and that of the
step that looks most alike (TBDP) run for 8 s, until the task says that they fell: from the guides' start with the
policy's noise; without noise from starts that differ by a part of the plan's deviations; and over four rough grounds of
each kind that no training saw. Writes gps_humanoid.csv and, with --update-results, the table of docs/gps_terrain.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import mean

import torch
from common import CheckpointFlags, Part, measured, run
from gps_experiments import CONTROLLERS, RUN, controllers, load_run, noisy, scalars
from groups import grouped
from tables import Row
from torch import Tensor

import gps
from diffsim.planning import REAL, System
from diffsim.planning.terrains import named_terrains

SECONDS, COUNT = 8.0, 20  # of a trajectory; trajectories from noisy and perturbed starts
SEEDS = range(1000, 1004)
SIZES = {
    "policy's noise": (1.0,),
    "perturbed start": (0.05, 0.1, 0.2),
    "rough, 1 m (degrees)": (3.0, 5.0, 10.0),
    "rough, 2 m (degrees)": (3.0, 5.0, 10.0),
}
KEY = (*RUN, "case", "size", "controller")


def until_fall(system: System, x: Tensor, finite: Tensor) -> tuple[Tensor, Tensor]:
    """Control steps before robots fall (m,), all if they do not, and their mean speed along x until then (m,) [m/s].

    Of states x (m, T + 1, nx), whose steps were finite or not (m, T).
    """
    up = ~system.task.terminated(system.observe(x[:, 1:])) & finite
    steps = up.cumprod(1).sum(1)
    way = x[..., 0].gather(1, steps.unsqueeze(1)).squeeze(1) - x[:, 0, 0]
    return steps, way / (steps.clamp(min=1) * system.control_dt)


def measure(args: CheckpointFlags, path: Path) -> Iterator[Row]:
    """One row for each case, size and controller."""
    about, search = load_run(path)
    level, policy, guide = System(search.env, 1), search.network, search.guides[0]
    T = min(round(SECONDS / level.control_dt), search.args.horizon)
    rng = torch.Generator().manual_seed(gps.SEED)
    noise = policy.sigma * torch.randn(COUNT, T, level.nu, generator=rng, dtype=REAL)
    away = level.difference(guide.x, guide.x[:1]).std(0) * torch.randn(COUNT, level.nd, generator=rng, dtype=REAL)
    for case, size in ((case, size) for case, sizes in SIZES.items() for size in sizes):
        system, start, rough = level, guide.x[:1].expand(COUNT, -1), case.startswith("rough")
        if rough:
            names = [f"rough:{size:g}:{case.split()[1]}:{seed}" for seed in SEEDS]
            system, start = System(search.env, 1, named_terrains(*names)), start[: len(SEEDS)]
        elif case == "perturbed start":
            start = level.retract(start, size * away)
        for name, act in controllers(search).items():
            x, _, finite = system.rollout(start, T, noisy(act, noise) if case == "policy's noise" else act)
            steps, speed = until_fall(system, x, finite)
            numbers = dict(whole=steps == T, seconds=steps * level.control_dt, speed=speed)
            row = about | dict(case=case, size=size, controller=name, trajectories=len(x))
            yield row | scalars(**{key: value.double().mean() for key, value in numbers.items()})


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A row for each case and size, a column for each kind of run: mean seconds of policy / DDP / TBDP."""
    result, kinds = list[Row](), grouped(rows, "env", "variant")
    for case, size in grouped(rows, "case", "size"):
        row: dict[str, object] = {"": case, "size": size}
        for (_, variant), own in kinds.items():
            here = grouped((r for r in own if (r["case"], r["size"]) == (case, size)), "controller")
            seconds = (mean(float(r["seconds"]) for r in here[(name,)]) for name in CONTROLLERS)
            row[variant] = " / ".join(f"{s:.1f}" for s in seconds)
        result.append(row)
    return result


def main(args: CheckpointFlags) -> None:
    measured(args, Part("gps_humanoid", measure, KEY, "gps humanoid", "gps_terrain.md", table, everywhere=True))


if __name__ == "__main__":
    run(main, CheckpointFlags, __doc__)

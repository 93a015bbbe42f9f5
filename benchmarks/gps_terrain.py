"""How far robots of guided policy search get on slopes, steps and rough ground, beside their guides (Figures 3 to 5).

    python benchmarks/gps_terrain.py runs/gps/walker__feedback-short__1 runs/gps/humanoid__spread-3__1

Takes runs of gps.py and gps_ground.py in folders TASK__CASE__SEED. The policy, the DDP controller and that of the step
that looks most alike (TBDP) get heights over the ground as a task's observations do; velocities and angles are the
world's. None sees the terrain.

Each terrain has ten profiles: a slope or step begins at ten places 10 cm apart, so that a robot meets it in ten phases
of its gait; rough ground has ten seeds. A robot stands if its root never sinks 0.45 m below its start's height over the
ground. It has walked over a terrain if it stands to the end and has come at least 90 % as far as the guides. It keeps
the guides' return if it stands, and that is within a quarter.

A humanoid runs for 8 s, until the task says that it fell: from the guides' start with the policy's noise; without noise
from starts that differ by a part of the plan's deviations; and over four rough grounds of each kind.

Writes gps_terrain.csv, gps_humanoid.csv and, with --update-results, the tables of docs/gps_terrain.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean

import torch
from common import CheckpointFlags, Part, checkpoint_of, measured, run
from gps_experiments import CONTROLLERS, RUN, controllers, keeps, load_run, noisy, scalars
from gps_ground import Ground, named_terrains
from groups import grouped, numbers
from tables import Row
from torch import Tensor

import gps
from diffsim.planning import REAL, System

Rows = list[dict[str, str]]
PLACES = [0.5 + 0.1 * i for i in range(10)]  # m, where a slope or a step begins
SEEDS = range(1000, 1010)
FALL, FAR = 0.45, 0.9  # m; of the guides' way
SIZES = {  # of each terrain
    "incline (degrees)": (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0),
    "step (cm)": (-5.0, -2.0, 2.0, 5.0),
    "rough, 1 m (degrees)": (5.0, 10.0),
    "rough, 2 m (degrees)": (5.0, 10.0),
}
HIDDEN = {*(-2.5, 2.5), *(-2.0, 2.0)}  # slopes and steps that the table leaves out
GROUNDS = {  # the walker's training, by the cases of gps_experiments.py; guides are shown of the last
    "feedback-short": "level",
    "feedback-slope": "one slope",
    "feedback-rough": "rough",
    "feedback-guides": "11 terrains",
    "feedback-practice": "level, random",
    "feedback-terrain": "11 terrains, random",
}
SECONDS, COUNT = 8.0, 20  # of a humanoid's trajectory; trajectories from noisy and perturbed starts
HUMANOID = {
    "policy's noise": (1.0,),
    "perturbed start": (0.05, 0.1, 0.2),
    "rough, 1 m (degrees)": (3.0, 5.0, 10.0),
    "rough, 2 m (degrees)": (3.0, 5.0, 10.0),
}


def names(terrain: str, size: float, seeds: Sequence[int] = SEEDS, start: float = PLACES[0]) -> list[str]:
    """As gps_ground.named_terrains takes them; rough ground begins at x = start."""
    kind, segment = terrain.split()[0], "1" if "1 m" in terrain else "2"
    if kind.startswith("rough"):
        return [f"rough:{size:g}:{segment}:{seed}:{start}" for seed in seeds]
    return [f"{kind}:{size:g}:{place:g}" for place in PLACES]


def until_fall(x: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Steps before robots fall (m,), all if they do not, and their way along x until then (m,) [m].

    Of states x (m, T + 1, nx), whose robots are up after each step or not (m, T).
    """
    steps = up.cumprod(1).sum(1)
    return steps, x[..., 0].gather(1, steps.unsqueeze(1)).squeeze(1) - x[:, 0, 0]


def is_humanoid(path: Path) -> bool:
    return checkpoint_of(path).parent.name.startswith("humanoid__")


def walks(args: CheckpointFlags, path: Path) -> Iterator[Row]:
    """One row for each terrain, size and controller."""
    if is_humanoid(path):
        return
    about, search = load_run(path)
    steps, height, guides = search.args.horizon, 2 if search.system.scene.floating else 1, search.guide_return[0]
    far = FAR * mean((guide.x[-1, 0] - guide.x[0, 0]).item() for guide in search.guides)
    start = search.guides[0].x[:1].expand(len(PLACES), -1)
    for terrain, size in ((terrain, size) for terrain, sizes in SIZES.items() for size in sizes):
        system = Ground(search.env, named_terrains(*names(terrain, size)), 1)
        for name, act in controllers(search).items():
            x, u, finite = system.rollout(start, steps, act)
            returns, up = search.measure(x, u, finite).returns, x[:, 1:, height] > x[:, :1, height] - FALL
            stood, distance = until_fall(x, up & finite)
            standing = stood == steps
            kept, walked = keeps(returns, guides) & standing, (distance >= far) & standing
            row = about | dict(T=steps, terrain=terrain, size=size, controller=name)
            shares = dict(kept=kept, walked=walked, standing=standing, distance=distance)
            row |= scalars(**{key: value.double().mean() for key, value in shares.items()})
            yield row | scalars(median_return=returns.median(), guides=guides)


def runs(args: CheckpointFlags, path: Path) -> Iterator[Row]:
    """One row of a humanoid for each case, size and controller."""
    if not is_humanoid(path):
        return
    about, search = load_run(path)
    level, policy, guide = System(search.env, 1), search.network, search.guides[0]
    T = min(round(SECONDS / level.control_dt), search.args.horizon)
    rng = torch.Generator().manual_seed(gps.SEED)
    noise = policy.sigma * torch.randn(COUNT, T, level.nu, generator=rng, dtype=REAL)
    away = level.difference(guide.x, guide.x[:1]).std(0) * torch.randn(COUNT, level.nd, generator=rng, dtype=REAL)
    for case, size in ((case, size) for case, sizes in HUMANOID.items() for size in sizes):
        system, start = level, guide.x[:1].expand(COUNT, -1)
        if case.startswith("rough"):
            terrains = names(case, size, SEEDS[:4], 1.0)
            system, start = Ground(search.env, named_terrains(*terrains), 1), start[: len(terrains)]
        elif case == "perturbed start":
            start = level.retract(start, size * away)
        for name, act in controllers(search).items():
            x, _, finite = system.rollout(start, T, noisy(act, noise) if case == "policy's noise" else act)
            steps, way = until_fall(x, ~system.task.terminated(system.observe(x[:, 1:])) & finite)
            speed = way / (steps.clamp(min=1) * level.control_dt)
            means = dict(whole=steps == T, seconds=steps * level.control_dt, speed=speed)
            row = about | dict(case=case, size=size, controller=name, trajectories=len(x))
            yield row | scalars(**{key: value.double().mean() for key, value in means.items()})


def table(rows: Rows) -> list[Row]:
    """A row for each terrain, a column for the walkers trained on each ground, and two for the last one's guides."""
    walkers = grouped((row for row in rows if row["env"] == "walker"), "variant", "controller")
    cases = [case for case in GROUNDS if (case, "policy") in walkers]
    columns = {GROUNDS[case]: walkers[case, "policy"] for case in cases}
    columns |= {name.upper(): walkers.get((cases[-1], name), []) for name in ("ddp", "tbdp") if cases}
    shown = [(terrain, [size]) for terrain, sizes in SIZES.items() for size in sizes if size not in HIDDEN]
    result = list[Row]()
    for terrain, sizes in [*shown, ("all", [])]:
        line: dict[str, object] = {"terrain": terrain, "size": f"{sizes[0]:g}" if sizes else ""}
        for column, own in columns.items():
            here = [r for r in own if not sizes or (r["terrain"] == terrain and float(r["size"]) in sizes)]
            line[column] = f"{100 * mean(numbers(here, 'walked')):.0f}" if here else ""
        result.append(line)
    return result


def humanoids(rows: Rows) -> list[Row]:
    """A row for each case and size, a column for each kind of run: mean seconds of policy / DDP / TBDP."""
    result = list[Row]()
    for (case, size), here in grouped(rows, "case", "size").items():
        row: dict[str, object] = {"": case, "size": size}
        for (_, variant), own in grouped(here, "env", "variant").items():
            kinds = grouped(own, "controller")
            row[variant] = " / ".join(f"{mean(numbers(kinds[name,], 'seconds')):.1f}" for name in CONTROLLERS)
        result.append(row)
    return result


TERRAIN = (*RUN, "T", "terrain", "size", "controller"), "gps terrain", "gps_terrain.md", table
RUNNING = (*RUN, "case", "size", "controller"), "gps humanoid", "gps_terrain.md", humanoids


def main(args: CheckpointFlags) -> None:
    measured(args, Part("gps_terrain", walks, *TERRAIN))
    measured(args, Part("gps_humanoid", runs, *RUNNING, everywhere=True))


if __name__ == "__main__":
    run(main, CheckpointFlags, __doc__)

"""Policies of guided policy search beside their guides on terrain (Figures 3 to 5).

    python benchmarks/gps_controllers.py runs/gps/walker__feedback-short__1 runs/gps/humanoid__spread-3__1

Takes runs of gps.py and gps_variants.py in folders TASK__CASE__SEED. DDP is the guide's controller by time, TBDP that
of the step that looks most alike. They and the policy get heights over the ground, and none sees the terrain.

- walked: the share that stands to the end (the root never sinks FALL below its start's height over the
  ground) and comes at least 90 % as far as the guides. A slope or step begins at ten places 10 cm apart, so that a
  robot meets it in ten phases of its gait; rough ground has ten seeds.
- seconds, of humanoids, also from perturbed starts: until the task says that it fell, at most 8.

Writes gps_controllers.csv and, with --update-results, the tables of docs/gps_terrain.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import mean

import torch
from common import CheckpointFlags, checkpoint_of, run
from gps_variants import CASES, Ground, VariantArgs, gps, named_terrains
from tables import Row, grouped, markdown, numbers
from torch import Tensor

from diffsim.planning import REAL, nearest_feedback
from diffsim.training import checkpoint
from diffsim.training.evaluation import make_env

Act = Callable[[int, Tensor], Tensor]
Found = tuple[Tensor, Tensor, Tensor]  # x (m, T + 1, nx), u (m, T, nu) and which steps are finite (m, T)
Trial = tuple[str, float, Callable[[Act], Found]]  # kind, size, and the trajectories of a controller
Rows = list[dict[str, str]]

KEY = ("env", "variant", "seed", "kind", "size", "controller")
CONTROLLERS = ("policy", "ddp", "tbdp")
COUNT = 20  # trajectories of each size, but over terrain
PLACES, SEEDS = [0.5 + 0.1 * i for i in range(10)], range(1000, 1010)  # of slopes and steps [m], of rough ground
FALL, FAR, SECONDS = 0.45, 0.9, 8.0  # m; of the guides' way; s
TERRAINS: dict[str, tuple[str, Sequence[float]]] = {  # names as named_terrains takes them, and sizes
    "incline (degrees)": ("incline:{size:g}:{place:g}", (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0)),
    "step (cm)": ("step:{size:g}:{place:g}", (-5.0, -2.0, 2.0, 5.0)),
    "rough, 1 m (degrees)": ("rough:{size:g}:1:{seed}:{start}", (5.0, 10.0)),
    "rough, 2 m (degrees)": ("rough:{size:g}:2:{seed}:{start}", (5.0, 10.0)),
}
RUNNING = (0.05, 0.1, 0.2), (3.0, 5.0, 10.0)  # a humanoid's perturbed starts, and degrees of rough ground
GROUNDS = {"feedback-short": "level", "feedback-slope": "one slope", "feedback-guides": "11 terrains"}  # of training


def load_search(path: Path) -> gps.Search:
    """The search of a checkpoint of gps.py or gps_variants.py."""
    state = checkpoint.load(path)
    kind = gps.Args if state["script"] == "gps" else VariantArgs
    args = kind(**state["args"] | {"device": "cpu"})
    search: gps.Search = (CASES[args.case] if isinstance(args, VariantArgs) else gps.Search)(args, make_env(args, 1))
    checkpoint.restore(search, state)
    return search


def controllers(search: gps.Search) -> dict[str, Act]:
    system, policy, guide = search.system, search.network, search.guides[0]
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        "ddp": lambda t, x: guide.mean(system, t, x),
        "tbdp": lambda _, x: nearest_feedback(system, search.guides, x, policy.obs_std)[0],
    }


# Trials ---------------------------------------------------------------------------------------------------------------


def starts(search: gps.Search, sizes: Sequence[float], steps: int) -> Iterator[Trial]:
    """Starts differ by a normal vector of a size times the standard deviation of each coordinate over the plan."""
    system, path = search.system, search.guides[0].x[:-1]
    draws = torch.randn(COUNT, system.nd, generator=torch.Generator().manual_seed(gps.SEED), dtype=REAL)
    away = system.difference(path, path[:1]).std(0) * draws
    for size in sizes:
        start = system.retract(path[:1].expand(COUNT, -1), size * away)
        yield "start", size, partial(system.rollout, start, steps)


def over(search: gps.Search, steps: int, terrain: str, size: float, count: int = 10, start: float = 0.5) -> Trial:
    places = list(zip(PLACES, SEEDS, strict=False))[:count]
    name = TERRAINS[terrain][0]
    names = [name.format(size=size, place=place, seed=seed, start=start) for place, seed in places]
    system, x = Ground(search.env, named_terrains(*names), 1), search.guides[0].x[:1].expand(len(names), -1)
    return terrain, size, partial(system.rollout, x, steps)


def walking(search: gps.Search) -> Iterator[Trial]:
    for terrain, (_, sizes) in TERRAINS.items():
        yield from (over(search, search.args.horizon, terrain, size) for size in sizes)


def running(search: gps.Search) -> Iterator[Trial]:
    steps, (sizes, degrees) = min(round(SECONDS / search.system.control_dt), search.args.horizon), RUNNING
    yield from starts(search, sizes, steps)
    for terrain in [*TERRAINS][2:]:
        yield from (over(search, steps, terrain, size, 4, 1.0) for size in degrees)


# Measures -------------------------------------------------------------------------------------------------------------


def walked(search: gps.Search, x: Tensor, u: Tensor, finite: Tensor) -> Tensor:
    height = 2 if search.system.scene.floating else 1
    up = (x[:, 1:, height] > x[:, :1, height] - FALL) & finite
    far = FAR * mean((guide.x[-1, 0] - guide.x[0, 0]).item() for guide in search.guides)
    return up.all(1) & (x[:, -1, 0] - x[:, 0, 0] >= far)


def seconds(search: gps.Search, x: Tensor, u: Tensor, finite: Tensor) -> Tensor:
    system = search.system
    up = ~system.task.terminated(system.observe(x[:, 1:])) & finite
    return up.cumprod(1).sum(1) * system.control_dt


MEASURES = {"walked": (walking, walked), "seconds": (running, seconds)}


def measure(path: Path) -> Iterator[Row]:
    """Of a run: one row for each trial and controller."""
    path = checkpoint_of(path)
    about, search = dict(zip(KEY, path.parent.name.split("__"), strict=False)), load_search(path)
    name = "seconds" if about["env"] == "humanoid" else "walked"
    trials, value = MEASURES[name]
    for kind, size, roll in trials(search):
        for controller, act in controllers(search).items():
            row = about | dict(kind=kind, size=f"{size:g}", controller=controller)
            yield row | {name: value(search, *roll(act)).double().mean().item()}


# Tables ---------------------------------------------------------------------------------------------------------------


def beside(rows: Rows, column: str, measure: str, form: str) -> list[Row]:
    """A line for each trial, a column for each of `column`: means over seeds, policy / DDP / TBDP."""
    result = list[Row]()
    for (trial,), here in grouped((row for row in rows if row.get(measure)), "trial").items():
        line: dict[str, object] = {"trial": trial}
        for (name,), own in grouped(here, column).items():
            kinds = grouped(own, "controller")
            line[name] = " / ".join(f"{mean(numbers(kinds[each,], measure)):{form}}" for each in CONTROLLERS)
        result.append(line)
    return result


def printed(rows: Rows) -> dict[str, list[Row]]:
    """The tables by their names in the page."""
    rows = [row | {"trial": f"{row['kind']} {row['size']}"} for row in rows]
    walks = [row | {"trained on": name} for case, name in GROUNDS.items() for row in rows if row["variant"] == case]
    walks += [row | {"trial": "all"} for row in walks]
    return {
        "gps terrain": beside(walks, "trained on", "walked", ".0%"),
        "gps humanoid": beside(rows, "variant", "seconds", ".1f"),
    }


def main(args: CheckpointFlags) -> None:
    for path in args.measured:
        for row in measure(path):
            args.keep("gps_controllers", row, KEY)
    for name, table in printed(args.read("gps_controllers")).items():
        args.publish(name, markdown(table), "gps_terrain.md", everywhere=True)


if __name__ == "__main__":
    run(main, CheckpointFlags, __doc__)

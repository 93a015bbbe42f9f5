"""Policies of guided policy search beside their guides on terrain (Figures 3 to 5).

    python benchmarks/gps_controllers.py runs/gps/walker__incline__1 runs/gps/walker__rough__1

Takes runs of gps.py and gps_variants.py in folders TASK__CASE__SEED. DDP is the first guide's controller by time, TBDP
that of the step of all guides that looks most alike. None sees the terrain. A trajectory counts as walked if the robot
stands to its end (the root never sinks FALL below its start's height over the ground) and comes at least FAR as far as
the guides.

Writes gps_controllers.csv and, with --update-results, the table of docs/gps.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from statistics import mean

import torch
from common import CheckpointFlags, checkpoint_of, run
from gps_variants import CASES, Ground, VariantArgs, gps, named_terrains
from tables import Row, grouped, markdown, numbers
from torch import Tensor

from diffsim.training import checkpoint
from diffsim.training.evaluation import make_env

Act = Callable[[int, Tensor], Tensor]
Rows = list[dict[str, str]]

KEY = ("env", "variant", "seed", "kind", "terrain", "controller")
CONTROLLERS = ("policy", "ddp", "tbdp")
FALL, FAR = 0.45, 0.9  # m; of the guides' way
COUNT = 10  # trajectories over each terrain, from the same start with the policy's noise


def terrains(degrees: int) -> dict[str, list[str]]:
    """What is walked over: an incline of so many degrees that begins at ten places, and four rough grounds."""
    return {
        f"incline of {degrees}°": [f"incline:{degrees}:{0.5 * place}" for place in range(1, 11)],
        f"rough ground of {degrees}°": [f"rough:{degrees}:{size}:{seed}" for size in (1, 2) for seed in (1001, 1002)],
    }


def load_search(path: Path) -> gps.Search:
    """The search of a checkpoint of gps.py or gps_variants.py."""
    state = checkpoint.load(path)
    kind = gps.Args if state["script"] == "gps" else VariantArgs
    args = kind(**state["args"] | {"device": "cpu"})
    search: gps.Search = (CASES[args.case] if isinstance(args, VariantArgs) else gps.Search)(args, make_env(args, 1))
    checkpoint.restore(search, state)
    return search


def controllers(search: gps.Search) -> dict[str, Act]:
    """Their mean actions at step t, of states (m, nx)."""
    system, policy, guide = search.system, search.network, search.guides[0]
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        "ddp": lambda t, x: guide.mean(system, t, x),
        "tbdp": nearest(search),
    }


def nearest(search: gps.Search) -> Act:
    """The feedback of the guides' step whose observation is nearest, in deviations of observations.

    The place along x does not count: it is not observed, and a guide's is that of its own terrain.
    """
    system, scale = search.system, search.network.obs_std
    path, u, K = (torch.cat(parts) for parts in zip(*((g.x[:-1], g.u, g.K) for g in search.guides), strict=True))
    looks = system.observe(path) / scale

    def act(_: int, x: Tensor) -> Tensor:
        own = system.observe(x) / scale
        t = torch.cdist(own, looks, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
        away = system.difference(x, path[t])
        away[:, system.task.forward_column] = 0.0
        return u[t] + (K[t] @ away.unsqueeze(-1)).squeeze(-1)

    return act


def walked(search: gps.Search, x: Tensor, finite: Tensor) -> Tensor:
    """(m,) of trajectories x (m, T + 1, nx)."""
    height, forward = 2 if search.system.scene.floating else 1, search.system.task.forward_column
    up = (x[:, 1:, height] > x[:, :1, height] - FALL) & finite
    way = mean((guide.x[-1, forward] - guide.x[0, forward]).item() for guide in search.guides)
    return up.all(1) & (x[:, -1, forward] - x[:, 0, forward] >= FAR * way)


def measure(path: Path) -> Iterator[Row]:
    """Of a run: one row for each terrain and controller."""
    path = checkpoint_of(path)
    about, search = dict(zip(KEY, path.parent.name.split("__"), strict=False)), load_search(path)
    steps, sigma = search.args.horizon, search.network.sigma
    noise = sigma * search.noise(COUNT, torch.Generator().manual_seed(gps.SEED))
    start, acts = search.guides[0].x[:1].expand(COUNT, -1), controllers(search)
    for kind, names in terrains(3 if about["env"] == "humanoid" else 10).items():
        for terrain, (name, act) in product(names, acts.items()):
            ground = Ground(search.env, named_terrains(terrain), 1)
            x, _, finite = ground.rollout(start, steps, lambda t, x, act=act: act(t, x) + noise[:, t])  # type: ignore[misc]
            share = walked(search, x, finite).double().mean().item()
            yield about | dict(kind=kind, terrain=terrain, controller=name, walked=share)


def table(rows: Rows) -> list[Row]:
    """A line for each kind of terrain, a column for each training: means over places, seeds; policy / DDP / TBDP."""
    result = list[Row]()
    for (kind,), here in grouped(rows, "kind").items():
        line: dict[str, object] = {"terrain": kind}
        for (name,), own in grouped(here, "variant").items():
            kinds = grouped(own, "controller")
            line[name] = " / ".join(f"{mean(numbers(kinds[each,], 'walked')):.0%}" for each in CONTROLLERS)
        result.append(line)
    return result


def main(args: CheckpointFlags) -> None:
    for path in args.measured:
        for row in measure(path):
            args.keep("gps_controllers", row, KEY)
    args.publish("gps terrain", markdown(table(args.read("gps_controllers"))), "gps.md", everywhere=True)


if __name__ == "__main__":
    run(main, CheckpointFlags, __doc__)

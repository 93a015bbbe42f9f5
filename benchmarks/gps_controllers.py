"""Guides and policies of guided policy search as controllers: on terrain, and how fast they leave the example.

    python benchmarks/gps_controllers.py runs/gps/walker__incline__1 runs/gps/walker__rough__1
    python benchmarks/gps_controllers.py --growth hopper walker

Terrain (Figures 3 to 5): takes runs of gps.py and gps_variants.py in folders TASK__CASE__SEED. DDP is a guide's
controller by time; the table shows that of the best guide. TBDP is that of the step of all guides that looks most
alike. None sees the terrain. A trajectory
counts as walked if the robot stands to its end (the root never sinks FALL below its start's height over the ground) and
comes at least FAR as far as the guides.

Growth: the policy is fitted to the guides of a shipped example, as it is and after iterations of iLQR. Its closed loop
is linearised along the example. The rate is the largest Lyapunov exponent of the product of these matrices, of all
states but the place along x, on which nothing depends. About 0 is a stable cycle (a shift in time neither grows nor
decays), and 1 / s is a deviation that grows by e each second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean

import torch
from common import CheckpointFlags, checkpoint_of, run
from gps_variants import CASES, Ground, VariantArgs, gps, named_terrains
from tables import Cells, Row, grouped, markdown, numbers
from torch import Tensor

from diffsim.planning import step_jacobian
from diffsim.training import checkpoint, parse
from diffsim.training.evaluation import make_env

Act = Callable[[int, Tensor], Tensor]
Rows = list[dict[str, str]]

KEY = ("env", "variant", "seed", "kind", "terrain", "controller")
CONTROLLERS = ("policy", "ddp", "tbdp")  # ddp: the best of "ddp 1", "ddp 2", ..., one for each guide
FALL, FAR = 0.45, 0.9  # m; of the guides' way
COUNT = 10  # trajectories over each terrain, from the same start with the policy's noise
ITERATIONS = (0, 15)  # of iLQR, after which an example's growth is measured
LEFT = ("task", "iLQR iterations", "controller")  # key of gps_stability.csv


@dataclass
class Args(CheckpointFlags):
    growth: tuple[str, ...] = ()  # tasks whose example's growth is measured

    @property
    def measured(self) -> tuple[Path, ...]:
        return () if self.growth else super().measured


def terrains(env: str) -> dict[str, list[str]]:
    """What is walked over: an incline that begins at eight places, and four rough grounds of each steepness."""
    first, steeper = (3, ()) if env == "humanoid" else (10, (15, 20))
    return {f"incline of {first}°": [f"incline:{first}:{0.5 * place}" for place in range(1, 9)]} | {
        f"rough ground of {degrees}°": [f"rough:{degrees}:{size}:{seed}" for size in (1, 2) for seed in (1001, 1002)]
        for degrees in (first, *steeper)
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
    system, policy = search.system, search.network
    guides = enumerate(search.guides, 1)
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        **{f"ddp {k}": lambda t, x, guide=guide: guide.mean(system, t, x) for k, guide in guides},  # type: ignore[misc]
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
    for kind, names in terrains(about["env"]).items():
        for terrain, (name, act) in product(names, acts.items()):
            ground = Ground(search.env, named_terrains(terrain), 1)
            x, _, finite = ground.rollout(start, steps, lambda t, x, act=act: act(t, x) + noise[:, t])  # type: ignore[misc]
            share = walked(search, x, finite).double().mean().item()
            yield about | dict(kind=kind, terrain=terrain, controller=name, walked=share)


def table(rows: Rows) -> list[Row]:
    """A line for each kind of terrain, a column for each training: means over places, seeds; policy / DDP / TBDP."""
    result = list[Row]()
    for (kind,), here in grouped(rows, "kind").items():
        line = dict[str, object](over=kind, **dict.fromkeys((row["variant"] for row in rows), ""))
        for (name,), own in grouped(here, "variant").items():
            seeds = [shares(found) for found in grouped(own, "seed").values()]
            line[name] = " / ".join(f"{mean(each[name] for each in seeds):.0%}" for name in CONTROLLERS)
        result.append(line)
    return result


def shares(rows: Rows) -> dict[str, float]:
    """What each controller of one training walks on average; of the guides the best one."""
    each = {name: mean(numbers(found, "walked")) for (name,), found in grouped(rows, "controller").items()}
    return each | {"ddp": max(share for name, share in each.items() if name.startswith("ddp"))}


def growth(loop: Tensor, dt: float) -> float:
    """1/s: the largest Lyapunov exponent of matrices (T, n, n) of steps of dt seconds."""
    v, total = torch.ones(loop.shape[1], dtype=loop.dtype), 0.0
    for matrix in loop:
        v = matrix @ (v / v.norm())
        total += v.norm().log().item()
    return total / (len(loop) * dt)


def leaving(env: str, iterations: int) -> Iterator[Row]:
    """How fast a guide and the policy fitted to it leave the example, and the policy's error."""
    words = f"--env {env} --device cpu --ilqr-iterations {iterations} --pretraining 1500 --threads 1"
    flags = parse(gps.Args, words.split())
    search = gps.Search(flags, make_env(flags, 1))
    search.prepare(print)
    system, policy, guide = search.system, search.network, search.guides[0]
    x = guide.x[:-1].requires_grad_()
    mean = policy.mean(policy.theta, system.observe(x))
    slopes = torch.stack([torch.autograd.grad(part.sum(), x, retain_graph=True)[0] for part in mean.unbind(-1)], 1)
    f_z = step_jacobian(system, guide.x.detach()[None], guide.u[None])[0]
    A, B = f_z.split((system.nd, system.nu), -1)
    error = ((mean.detach() - guide.u) / policy.sigma).square().mean().sqrt().item()
    for name, K in {"guide": guide.K, "policy": slopes}.items():
        rate = growth((A + B @ K)[:, 1:, 1:], system.control_dt)
        about = dict(zip(LEFT, (env, iterations, name), strict=True))
        yield about | {"growth (1/s)": rate, "error (sigma)": error}


def rates(rows: list[Cells]) -> list[Row]:
    """A line for each example, a column for each controller's growth."""
    return [
        dict(zip(LEFT, key, strict=False))
        | {f"{row['controller']}, growth (1/s)": row["growth (1/s)"] for row in own}
        | {"policy's error (sigma)": own[0]["error (sigma)"]}
        for key, own in grouped(rows, *LEFT[:2]).items()
    ]


def main(args: Args) -> None:
    for path in args.measured:
        for row in measure(path):
            args.keep("gps_controllers", row, KEY)
    for env, iterations in () if args.draw_only else product(args.growth, ITERATIONS):
        for row in leaving(env, iterations):
            args.keep("gps_stability", row, LEFT)
    shown = [row for row in args.read("gps_controllers") if row["env"] != "humanoid"]  # whose policies fall everywhere
    args.publish("gps terrain", markdown(table(shown)), "benchmarks.md", everywhere=True)
    args.publish("gps stability", markdown(rates(args.read("gps_stability"))), "", everywhere=True)


if __name__ == "__main__":
    run(main, Args, __doc__)

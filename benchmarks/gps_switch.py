"""The walking example of Section 6.2 of guided policy search, which changes to another gait after half of its time.

    python benchmarks/gps_switch.py benchmarks/plans/walker_switch_300.npz

Its first half is that of walker_500.npz. The second is planned from there for a lower height, from random actions and
by windows: no policy without a clock can tell when to crouch. gps.py takes the file as --demonstration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tables import ROOT

import gps
from diffsim.planning import (
    best_of_random_starts,
    ilqr,
    load_demonstration,
    receding_horizon,
    save_demonstration,
    starting_actions,
)
from diffsim.training import command
from diffsim.training.evaluation import make_env


@dataclass
class Args:
    output: Annotated[Path, tyro.conf.Positional]  # the .npz to write
    steps: int = 300  # of the whole example
    height: float = 1.2  # target_height of the second gait, m; the first one's is 1.35
    seed: int = 2  # of its random starts


@command
def main(argv: list[str] | None = None) -> None:
    args = tyro.cli(Args, args=argv, description=__doc__)
    torch.set_num_threads(1)
    words = f"--env walker --device cpu --threads 1 --target-height {args.height}"
    flags = gps.parse(gps.Args, words.split())
    search, half, rng = gps.Search(flags, make_env(flags, 1)), args.steps // 2, torch.Generator().manual_seed(args.seed)
    system, cost, W = search.system, search.cost, flags.window
    x, u = load_demonstration(system, ROOT / "benchmarks" / "plans" / "walker_500.npz", half)
    actions = starting_actions(8, W, system.nu, system.control_dt, rng)
    later = best_of_random_starts(system, cost, x[-1], actions, 1, flags.screening)
    later = receding_horizon(system, cost, *later, args.steps - half, W // 5, 8, rng)
    plan = ilqr(system, cost, *later, 20)
    save_demonstration(system, [(torch.cat((x[:-1], plan.x[0])), torch.cat((u, plan.u[0])))], args.output)
    print(f"costs {cost.value(x[None, None], u[None, None]).sum():.2f} and {plan.cost[0]:.2f}: {args.output}")


if __name__ == "__main__":
    main()

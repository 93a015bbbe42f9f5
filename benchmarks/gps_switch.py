"""The walking example of Section 6.2 of guided policy search, which changes to another gait after half of its time.

    python benchmarks/gps_switch.py benchmarks/plans/walker_switch_300.npz

Its first half is that of walker_500.npz. The second is planned from there for a lower height, from random actions and
by windows: no policy without a clock can tell when to crouch. gps.py takes the file as --demonstration.
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro
from tables import ROOT
from tyro.conf import Positional

import gps
from diffsim.planning import (
    best_of_random_starts,
    ilqr,
    load_demonstration,
    receding_horizon,
    save_demonstration,
    starting_actions,
)
from diffsim.training import command, parse
from diffsim.training.evaluation import make_env

STEPS, HEIGHT = 300, 1.2  # of the whole example; target_height of the second gait, m (the first one's is 1.35)
SEED, STARTS = 2, 8  # of the second half's random actions; their number


@command
def main(output: Positional[Path]) -> None:
    torch.set_num_threads(1)
    flags = parse(gps.Args, f"--env walker --device cpu --threads 1 --target-height {HEIGHT}".split())
    search, half, rng = gps.Search(flags, make_env(flags, 1)), STEPS // 2, torch.Generator().manual_seed(SEED)
    system, cost, W = search.system, search.cost, flags.window
    x, u = load_demonstration(system, ROOT / "benchmarks" / "plans" / "walker_500.npz", half)
    actions = starting_actions(STARTS, W, system.nu, system.control_dt, rng)
    later = best_of_random_starts(system, cost, x[-1], actions, 1, flags.screening)
    later = receding_horizon(system, cost, *later, STEPS - half, W // 5, 8, rng)
    plan = ilqr(system, cost, *later, 20)
    save_demonstration(system, [(torch.cat((x[:-1], plan.x[0])), torch.cat((u, plan.u[0])))], output)
    print(f"costs {cost.value(x[None, None], u[None, None]).sum():.2f} and {plan.cost[0]:.2f}: {output}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

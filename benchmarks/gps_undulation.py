"""What bounds the swimmer: the fastest undulation of bodies and motors, and the trajectory that iLQR makes of it.

    python benchmarks/gps_undulation.py                   writes gps_swimmer.csv (ten minutes on one core)
    python benchmarks/gps_undulation.py --plan benchmarks/plans/swimmer_500.npz     a demonstration for gps.py

The joints follow sinusoids of one frequency by proportional-derivative control. Seven numbers (amplitude, its ratio,
frequency, lag, phase, both gains) are found by the cross-entropy method: a population is drawn, the best twelfth are
fitted by a normal distribution, and so on. "top speed" maximises the mean speed of the second half with motors at
their limits; "return" maximises what gps.py does.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import torch
import tyro
from common import OUTPUT, RESULTS
from tables import ROOT, write_csv
from torch import Tensor

import diffsim
from diffsim.planning import REAL, Plan, ilqr, save_demonstration
from diffsim.tasks import TASKS

sys.path.append(str(ROOT))
import gps  # noqa: E402

BODIES = ((".05", 100), (".05", 200), (".025", 100), (".025", 200))  # radius of the links (m), motors (N m)
MEAN, STD = (0.7, 4.0, -1.2, 0.0, 0.5, 0.0, 0.0), (0.3, 1.5, 0.8, 0.4, 0.8, 1.0, 1.0)


@dataclass
class Args:
    horizon: int = 160
    """control steps"""
    population: int = 300
    """undulations of a generation"""
    generations: int = 12
    """of the cross-entropy method"""
    ilqr_iterations: int = 60
    """iLQR iterations from the undulation of the highest return"""
    plan: Path | None = None
    """write the swimmer's trajectory of 500 steps here; nothing else is done"""
    update_results: bool = False
    """write to results/cpu of this repository"""


def make_search(radius: str, torque: int, horizon: int) -> gps.Search:
    """The task's with another body."""
    assets, task = files("diffsim") / "assets", TASKS["swimmer"]
    with tempfile.TemporaryDirectory() as directory:
        text = (assets / "swimmer.xml").read_text().replace('size=".025"', f'size="{radius}"')
        (Path(directory) / "swimmer.xml").write_text(text.replace('gear="200"', f'gear="{torque}"'))
        (Path(directory) / "stage.xml").write_text((assets / "stage.xml").read_text())
        before, task.asset = task.asset, f"{directory}/swimmer.xml"
        try:
            env = diffsim.make("swimmer", 1)
        finally:
            task.asset = before
    flags = ["--env", "swimmer", "--device", "cpu", "--threads", "1", "--horizon", str(horizon)]
    flags += ["--ilqr-iterations", "60", "--screening", "20"]
    return gps.Search(gps.parse(gps.Args, flags), env)


def speed(search: gps.Search, x: Tensor) -> Tensor:
    """(...) mean forward speed of the head over the second half of x (..., T + 1, nx)."""
    half = x.shape[-2] // 2
    return (x[..., -1, 0] - x[..., half, 0]) / ((x.shape[-2] - 1 - half) * search.system.control_dt)


def undulate(search: gps.Search, args: Args, fastest: bool) -> tuple[Tensor, Tensor]:
    """The best undulation found: x (1, T + 1, nx), u (1, T, nu)."""
    system, T, n = search.system, search.args.horizon, args.population
    rng = torch.Generator().manual_seed(1)
    center, std = torch.tensor(MEAN, dtype=REAL), torch.tensor(STD, dtype=REAL)
    for _ in range(args.generations):
        draws = center + std * torch.randn(n, len(MEAN), generator=rng, dtype=REAL)
        amplitude, frequency, lag, ratio, k_p, k_d, phase = draws.T
        wave = amplitude.abs().unsqueeze(1) * torch.stack((torch.ones_like(ratio), ratio.exp()), 1)
        omega = 2 * math.pi * frequency.abs().unsqueeze(1)
        shift = torch.stack((phase, phase + lag), 1)
        k_p, k_d = 0.5 * k_p.exp().unsqueeze(1), 0.005 * k_d.exp().unsqueeze(1)

        def act(t: int, x: Tensor) -> Tensor:
            time = t * system.control_dt
            angle = omega * time + shift  # noqa: B023
            target, rate = wave * angle.sin(), wave * omega * angle.cos()  # noqa: B023
            start = min(time / 0.3, 1.0)
            action = k_p * (start * target - x[:, 3:5]) + k_d * (start * rate - x[:, 8:10])  # noqa: B023
            return action.clamp(-0.999, 0.999).atanh() if fastest else action.clamp(-2, 2)

        x, u, finite = system.rollout(system.start().expand(n, -1), T, act)
        value = speed(search, x) - 9.0 * (x[:, -1, 2].abs() > 1.5) if fastest else search.reward(x[:, 1:], u).sum(1)
        order = torch.where(finite.all(1), value, -math.inf).argsort(descending=True)
        best = draws[order[: n // 12]]
        center, std = best.mean(0), best.std(0) + 0.02
    return x[order[:1]], u[order[:1]]


def plan_from(search: gps.Search, args: Args) -> tuple[Tensor, Tensor, Plan]:
    x, u = undulate(search, args, fastest=False)
    return x, u, ilqr(search.system, search.cost, x, u, args.ilqr_iterations)


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    torch.set_num_threads(1)
    if args.plan:
        search = make_search(".025", 200, 500)
        plan = plan_from(search, args)[2]
        save_demonstration(search.system, [(plan.x[0], plan.u[0])], args.plan)
        print(f"return {-plan.cost.item():.1f}, {speed(search, plan.x).item():.2f} m/s: {args.plan}")
        return
    rows = []
    for radius, torque in BODIES:
        search = make_search(radius, torque, args.horizon)
        x, u, plan = plan_from(search, args)
        row = {"radius m": radius, "motor N m": torque}
        row["top speed m/s"] = f"{speed(search, undulate(search, args, fastest=True)[0]).item():.2f}"
        row |= {"undulation": f"{search.reward(x[:, 1:], u).sum().item():.0f}", "m/s": f"{speed(search, x).item():.2f}"}
        row |= {"plan from it": f"{-plan.cost.item():.0f}", "plan m/s": f"{speed(search, plan.x).item():.2f}"}
        scratch = gps.plan_trajectories(search, "level", lambda text: None)
        row |= {"random plan": f"{-scratch.cost.item():.0f}", "random m/s": f"{speed(search, scratch.x).item():.2f}"}
        rows.append(row)
        print(row, flush=True)
    write_csv((RESULTS if args.update_results else OUTPUT) / "cpu" / "gps_swimmer.csv", rows)


if __name__ == "__main__":
    main()

"""Why an improved example is hard to learn: how fast a clockless policy leaves it (docs/gps.md).

    python benchmarks/gps_stability.py --env walker

The policy is fitted to the guides of a shipped example, as it is and after iterations of iLQR. Its closed loop is
linearised along the example. The growth rate is the largest Lyapunov exponent of the product of these matrices, of
all states but the place along x, on which nothing depends. About 0 is a stable cycle (a shift in time neither grows nor
decays), and 1 / s is a deviation that grows by e each second. Writes gps_stability.csv.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from common import CommonFlags, run
from gps_variants import gps
from tables import Cells, Row, grouped, markdown
from torch import Tensor

from diffsim.planning import step_jacobian
from diffsim.training import parse
from diffsim.training.evaluation import make_env

KEY = ("task", "iLQR iterations", "controller")


@dataclass
class Args(CommonFlags):
    env: tuple[str, ...] = ("hopper", "walker")  # type: ignore[assignment]
    iterations: tuple[int, ...] = (0, 15)  # of iLQR
    pretraining: int = 1500  # L-BFGS iterations


def growth(loop: Tensor, dt: float) -> float:
    """1/s: the largest Lyapunov exponent of matrices (T, n, n) of steps of dt seconds."""
    v, total = torch.ones(loop.shape[1], dtype=loop.dtype), 0.0
    for matrix in loop:
        v = matrix @ (v / v.norm())
        total += v.norm().log().item()
    return total / (len(loop) * dt)


def measure(env: str, iterations: int, args: Args) -> Iterator[Row]:
    words = f"--env {env} --device cpu --ilqr-iterations {iterations} --pretraining {args.pretraining} --threads 1"
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
        about = dict(zip(KEY, (env, iterations, name), strict=True))
        yield about | {"growth (1/s)": rate, "error (sigma)": error}


def table(rows: list[Cells]) -> list[Row]:
    """A line for each example, a column for each controller's growth."""
    return [
        dict(zip(KEY, key, strict=False))
        | {f"{row['controller']}, growth (1/s)": row["growth (1/s)"] for row in own}
        | {"policy's error (sigma)": own[0]["error (sigma)"]}
        for key, own in grouped(rows, *KEY[:2]).items()
    ]


def main(args: Args) -> None:
    for env in args.measured:
        for iterations in args.iterations:
            for row in measure(env, iterations, args):
                args.keep("gps_stability", row, KEY)
    args.publish("gps stability", markdown(table(args.read("gps_stability"))), "gps.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

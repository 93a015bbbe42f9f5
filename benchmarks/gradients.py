"""What firm contact does to gradients: their size and their agreement, against horizon and stiffness.

    python benchmarks/gradients.py runs/learning/shac_firm/*__1        policies of tasks with ground, one of each

A policy acts with noise from states that it visits. The gradient of a window's reward is taken with respect to
the window's own actions: how long it is in each environment; and with respect to a shift of the policy's output: how
well the gradients of separate groups of environments agree. Ground and limits go from the soft constants to the firm
ones geometrically, as --anneal takes them, and on to four times those. Writes gradients.csv and gradients.png.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import common
import torch
from common import Line, Panel, Part, measured, plot, run
from tables import Row
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.training import Count, NonNegative, fail
from diffsim.training.evaluation import SEED
from diffsim.training.variation import VARIED, soft_factors

GROUPS = 16  # of environments, whose gradients are compared
FIRMER = 4.0  # the last ground's constants in multiples of the firm ones
GROUNDS = {"soft": 0.0, "25 % firm": 0.25, "50 % firm": 0.5, "75 % firm": 0.75, "firm": 1.0}  # of the way to firm
COLUMNS = {"norm": ("norm, median", "y"), "norm 95 %": ("norm, 95 %", "y"), "cosine": ("cosine", "")}
KEY = ("task", "learner", "horizon", "stiffness")


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 256  # environments
    horizons: tuple[Count, ...] = (4, 8, 16, 32, 64)  # control steps of a window
    warmup: Count = 100  # control steps before it
    noise: NonNegative = 0.2  # standard deviation of the noise on the actions


def grounds(env: DiffEnv) -> dict[str, Tensor]:
    """Factors (len(FACTORS),) of the firm constants, by the name of the ground."""
    soft = torch.tensor([soft_factors(env.scene).get(name, 1.0) for name in FACTORS])
    found = {}
    # A limit's damping, which is none where it is soft, goes with the share, as in Variation.
    for name, share in GROUNDS.items():
        found[name] = torch.where(soft > 0, soft.clamp(min=1e-30) ** (1 - share), share)
    varied = torch.tensor([name in VARIED["stiffness"] for name in FACTORS])
    return found | {f"{FIRMER:g} x firm": torch.where(varied, FIRMER, 1.0)}


def window_gradients(env: DiffEnv, policy: torch.nn.Module, horizon: int, args: Args) -> tuple[Tensor, Tensor]:
    """Of the reward of a window: per environment, with respect to its actions (N, horizon, nu), and per group, the mean
    with respect to a shift of the policy's output (GROUPS, nu)."""
    noise = torch.Generator().manual_seed(SEED)

    def act(obs: Tensor) -> Tensor:
        action = policy(obs)
        return action + args.noise * torch.randn(action.shape, generator=noise)

    obs, _ = env.reset(seed=SEED)
    with torch.no_grad():
        for _ in range(args.warmup):
            obs = env.step(act(obs))[0]
    obs, total = env.detach(), torch.zeros(env.num_envs)
    shift = torch.zeros(env.num_envs, env.scene.nu, requires_grad=True)
    own = [torch.zeros_like(shift, requires_grad=True) for _ in range(horizon)]
    for change in own:
        obs, reward, *_ = env.step(act(obs) + shift + change)
        total = total + reward
    each = torch.stack(torch.autograd.grad(total.sum(), own, retain_graph=True), 1)
    (through,) = torch.autograd.grad(total.sum(), shift)
    return each, through.unflatten(0, (GROUPS, -1)).mean(1)


def agreement(gradients: Tensor) -> float:
    """Mean cosine between the gradients (groups, n) of two groups."""
    unit = torch.nn.functional.normalize(gradients, dim=1)
    cosines = unit @ unit.T
    return float((cosines.sum() - cosines.trace()) / (len(unit) * (len(unit) - 1)))


def measure(args: Args, path: Path) -> Iterator[Row]:
    """Rows of one policy."""
    case = common.load_case(path, 1, "cpu")
    task = case.env.task.name
    if "contact" not in case.env.scene.features:
        fail(f"{path} was trained on {task}, which has no ground")
    integration = case.env.task.integration("default", "firm")
    for horizon in args.horizons:
        env = diffsim.make(
            task,
            args.num_envs,
            horizon=horizon,
            contact="firm",
            substeps=integration.substeps,
            factors=True,
        )
        for k, (name, factors) in enumerate(grounds(env).items()):
            env.sim.factors.copy_(factors)
            each, groups = window_gradients(env, case.saved.network, horizon, args)
            norms = each.flatten(1).norm(dim=1)
            yield {
                "task": task,
                "learner": case.saved.script,
                "horizon": horizon,
                "stiffness": k,
                "ground": name,
                "k_n": float(env.scene.k_n * factors[FACTORS.index("k_n")]),
                "norm": float(norms.median()),
                "norm 95 %": float(norms.quantile(0.95)),
                "cosine": agreement(groups),
                "environments": args.num_envs,
            }


def shown(rows: list[dict[str, str]]) -> list[Row]:
    """What the page has of the rows."""
    ends, columns = {"soft", "firm", f"{FIRMER:g} x firm"}, ("task", "horizon", "ground", *COLUMNS)
    own = (row for row in rows if row["ground"] in ends and row["horizon"] in ("8", "32"))
    return [{name: row[name] for name in columns} for row in own]


def main(args: Args) -> None:
    if args.num_envs % GROUPS:
        fail(f"--num-envs {args.num_envs} is not a multiple of {GROUPS}, the groups that are compared")
    rows = measured(args, Part("gradients", measure, KEY, "gradients", "transfer.md", shown))
    tasks = [name for name in common.TASKS if any(row["task"] == name for row in rows)]
    grid = list[list[Panel]]()
    for column, (text, log) in COLUMNS.items():
        panels = list[Panel]()
        for task in tasks:
            lines = list[Line]()
            for ground in dict.fromkeys(row["ground"] for row in rows):
                own = [row for row in rows if (row["task"], row["ground"]) == (task, ground)]
                x, y = ([float(row[name]) for row in own] for name in ("horizon", column))
                lines.append(Line(x, y, f"C{own[0]['stiffness']}o-", ground) if own else Line([], []))
            panels.append(Panel(lines, task, "horizon (control steps)", text, log))
        grid.append(panels)
    if tasks:
        plot(args.picture("gradients"), grid)


if __name__ == "__main__":
    run(main, Args, __doc__)

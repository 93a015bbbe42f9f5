"""What hard contact does to gradients: their size and their agreement, against horizon and hardness.

    python benchmarks/gradients.py runs/learning/shac/*__1        policies of tasks with ground, one of each

A policy acts with noise from states that it visits. The gradient of a window's reward is taken with respect to
the window's own actions: how long it is in each environment; and with respect to a shift of the policy's output: how
well the gradients of separate groups of environments agree. The grounds are the paper's springs and MuJoCo's own
contact, as hard as the file's and softer, from where --anneal may begin. Writes gradients.csv and gradients.png.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import common
import torch
from common import Line, Panel, Part, measured, plot, run
from tables import Row
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.tasks import Contact
from diffsim.training import Count, NonNegative, fail
from diffsim.training.evaluation import SEED
from diffsim.training.variation import SOFT

GROUPS = 16  # of environments, whose gradients are compared
# By their names in the csv file: the contact, and the factor of k_d, which in MuJoCo's contact multiplies all force
GROUNDS: dict[str, tuple[Contact, float]] = {"soft": ("soft", 1.0)}
GROUNDS |= {f"mujoco x{factor:g}": ("mujoco", factor) for factor in (SOFT["k_d"], 0.1, 1.0)}
COLUMNS = {"norm": ("norm, median", "y"), "norm 95 %": ("norm, 95 %", "y"), "cosine": ("cosine", "")}
KEY = ("task", "learner", "horizon", "ground")


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 256  # environments
    horizons: tuple[Count, ...] = (4, 8, 16, 32, 64)  # control steps of a window
    warmup: Count = 100  # control steps before it
    noise: NonNegative = 0.2  # standard deviation of the noise on the actions


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
    for horizon in args.horizons:
        kinds: tuple[Contact, ...] = get_args(Contact)
        envs = {kind: diffsim.make(task, args.num_envs, horizon=horizon, contact=kind, factors=True) for kind in kinds}
        for name, (kind, factor) in GROUNDS.items():
            env = envs[kind]
            env.sim.factors[:, FACTORS.index("k_d")] = factor
            each, groups = window_gradients(env, case.saved.network, horizon, args)
            norms = each.flatten(1).norm(dim=1)
            yield {
                "task": task,
                "learner": case.saved.script,
                "horizon": horizon,
                "ground": name,
                "norm": float(norms.median()),
                "norm 95 %": float(norms.quantile(0.95)),
                "cosine": agreement(groups),
                "environments": args.num_envs,
            }


def shown(rows: list[dict[str, str]]) -> list[Row]:
    """What the page has of the rows."""
    own = (row for row in rows if row["horizon"] in ("8", "32"))
    return [{name: row[name] for name in ("task", "horizon", "ground", *COLUMNS)} for row in own]


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
            for k, ground in enumerate(GROUNDS):
                own = [row for row in rows if (row["task"], row["ground"]) == (task, ground)]
                x, y = ([float(row[name]) for row in own] for name in ("horizon", column))
                lines.append(Line(x, y, f"C{k}o-", ground) if own else Line([], []))
            panels.append(Panel(lines, task, "horizon (control steps)", text, log))
        grid.append(panels)
    if tasks:
        plot(args.picture("gradients"), grid)


if __name__ == "__main__":
    run(main, Args, __doc__)

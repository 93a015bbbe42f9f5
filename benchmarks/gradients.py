"""What hard contact does to gradients: their size, and whether they point where the mean return rises.

    python benchmarks/gradients.py runs/learning/ppo_mujoco/*__1        policies of tasks with ground, one of each

A policy acts with noise from states that it visits. The reward of a window is differentiated with respect to a shift
of all of the window's actions, in each environment: how long these gradients are, and how well their mean agrees with
differences of the mean reward, which see jumps that no derivative sees. The grounds are the paper's springs and
MuJoCo's own contact, whose gradients count that it begins with a jump, or not. Writes gradients.csv and gradients.png.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import torch
from common import Line, Panel, Part, measured, plot, run
from tables import Row
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.training import Count, NonNegative, Positive, fail
from diffsim.training.evaluation import SEED

GROUNDS: dict[str, dict[str, Any]] = {  # by their names in the csv file
    "soft": {"contact": "soft"},
    "mujoco": {"contact": "mujoco"},
    "mujoco --no-touchdown": {"contact": "mujoco", "touchdown": False},
}
COLUMNS = {"norm": ("norm, median", "y"), "norm 95 %": ("norm, 95 %", "y"), "cosine": ("cosine", "")}
KEY = ("task", "learner", "horizon", "ground")


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 1024  # environments
    horizons: tuple[Count, ...] = (2, 4, 8, 16, 32)  # control steps of a window
    warmup: Count = 150  # control steps before it
    noise: NonNegative = 0.3  # standard deviation of the noise on the actions
    difference: Positive = 0.05  # shift of the actions in either direction


def window(env: DiffEnv, policy: torch.nn.Module, horizon: int, shift: Tensor, noise: Tensor) -> Tensor:
    """(N,) rewards of the window from where env is; shift (N, nu) and noise (T, N, nu) add to the actions."""
    obs, total = env.detach(), torch.zeros_like(noise[0, :, 0])
    for k in range(horizon):
        obs, reward, *_ = env.step(policy(obs) + shift + noise[k])
        total = total + reward
    return total


@torch.no_grad()
def differences(env: DiffEnv, policy: torch.nn.Module, horizon: int, noise: Tensor, size: float) -> Tensor:
    """(nu,) central differences of the mean reward of a window."""
    start = env.qpos.clone(), env.qvel.clone()
    slopes = []
    for k in range(env.scene.nu):
        shift, ends = torch.zeros_like(noise[0]), []
        for shift[:, k] in (torch.tensor(size), torch.tensor(-size)):
            env.set_state(*start)
            ends.append(window(env, policy, horizon, shift, noise).mean())
        slopes.append((ends[0] - ends[1]) / (2 * size))
    env.set_state(*start)
    return torch.stack(slopes)


def measure(args: Args, path: Path) -> Iterator[Row]:
    """Rows of one policy."""
    case = common.load_case(path, 1, "cpu")
    task, policy, n = case.env.task.name, case.saved.network, args.num_envs
    if "contact" not in case.env.scene.features:
        fail(f"{path} was trained on {task}, which has no ground")
    for ground, options in GROUNDS.items():
        env = diffsim.make(task, n, horizon=max(args.horizons), early_termination=False, **options)
        env.reset(seed=SEED)
        drawn = torch.Generator().manual_seed(SEED)
        noise = args.noise * torch.randn(args.warmup, n, env.scene.nu, generator=drawn)
        with torch.no_grad():
            window(env, policy, args.warmup, torch.zeros(n, env.scene.nu), noise)
        start = env.qpos.detach().clone(), env.qvel.detach().clone()
        for horizon in args.horizons:
            noise = args.noise * torch.randn(horizon, n, env.scene.nu, generator=drawn)
            env.set_state(*start)
            slopes = differences(env, policy, horizon, noise, args.difference)
            shift = torch.zeros(n, env.scene.nu, requires_grad=True)
            (each,) = torch.autograd.grad(window(env, policy, horizon, shift, noise).sum(), shift)
            norms = each.norm(dim=1)
            yield {
                "task": task,
                "learner": case.saved.script,
                "horizon": horizon,
                "ground": ground,
                "norm": float(norms.median()),
                "norm 95 %": float(norms.quantile(0.95)),
                "cosine": float(torch.cosine_similarity(each.mean(0), slopes, dim=0)),
                "environments": n,
            }


def shown(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task and ground."""
    lines = dict[tuple[str, str], dict[str, object]]()
    for row in rows:
        line = lines.setdefault((row["task"], row["ground"]), {"task": row["task"], "ground": row["ground"]})
        line[f"cosine, {row['horizon']} steps"] = row["cosine"]
        line[f"norm 95 %, {row['horizon']} steps"] = row["norm 95 %"]
    names = "task", "ground", "cosine, 4 steps", "cosine, 8 steps", "cosine, 16 steps", "norm 95 %, 16 steps"
    return [{name: line.get(name, "") for name in names} for line in lines.values()]


def main(args: Args) -> None:
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

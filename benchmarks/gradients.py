"""What hard contact does to gradients: whether they point where the mean return rises.

    python benchmarks/gradients.py runs/learning/ppo_mujoco/*__1        policies of tasks with ground, one of each
    python benchmarks/gradients.py ant half_cheetah humanoid            tasks, whose robots get noise for actions

A policy acts with noise from states that it visits. The reward of a window is differentiated with respect to a shift
of all of the window's actions: how well its mean over the environments agrees with differences of the mean reward,
which see jumps that no derivative sees. Differences of two sizes must agree, or the mean reward has no slope to compare
with. The grounds are the paper's springs and MuJoCo's own contact. Writes gradients.csv.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import torch
from common import Part, measured, run
from tables import Row, grouped
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.tasks import find_task
from diffsim.training import Count, fail
from diffsim.training.evaluation import SEED

GROUNDS: dict[str, dict[str, Any]] = {  # by their names in the csv file
    "soft": {"contact": "soft"},
    "mujoco": {"contact": "mujoco"},
}
SHOWN = tuple(f"cosine, {k} steps" for k in (4, 8, 16))
NOISE, SHIFT = 0.3, 0.05  # standard deviation of the noise on the actions; their shift in either direction
AGREE = 0.9  # least cosine of differences by SHIFT and by half of it, for which the page shows others
KEY = ("task", "learner", "horizon", "ground")
Policy = Callable[[Tensor], Tensor | float]


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 1024  # environments
    horizons: tuple[Count, ...] = (2, 4, 8, 16, 32)  # control steps of a window
    warmup: Count = 150  # control steps before it


def still(obs: Tensor) -> float:
    """The policy of a task that is given without one."""
    return 0.0


def window(env: DiffEnv, policy: Policy, horizon: int, shift: Tensor, noise: Tensor) -> Tensor:
    """(N,) rewards of the window from where env is; shift (N, nu) and noise (T, N, nu) add to the actions."""
    obs, total = env.detach(), torch.zeros_like(noise[0, :, 0])
    for k in range(horizon):
        obs, reward, *_ = env.step(policy(obs) + shift + noise[k])
        total = total + reward
    return total


@torch.no_grad()
def differences(env: DiffEnv, policy: Policy, horizon: int, noise: Tensor, size: float) -> Tensor:
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
    """Rows of one policy, or of one task."""
    task, learner, policy, n = str(path), "noise", still, args.num_envs
    if task not in diffsim.TASKS:
        case = common.load_case(path, 1, "cpu")
        task, learner, policy = case.env.task.name, case.saved.script, case.saved.network
    if "contact" not in find_task(task)().scene().features:
        fail(f"{path}: {task} has no ground")
    for ground, contact in GROUNDS.items():
        options = contact | {"horizon": max(args.horizons), "early_termination": False, "max_episode_steps": 10**9}
        env = diffsim.make(task, n, **options)  # in which no episode ends: a reset within a window is no slope
        env.reset(seed=SEED)
        drawn = torch.Generator().manual_seed(SEED)
        noise = NOISE * torch.randn(args.warmup, n, env.scene.nu, generator=drawn)
        with torch.no_grad():
            window(env, policy, args.warmup, torch.zeros(n, env.scene.nu), noise)
        start = env.qpos.detach().clone(), env.qvel.detach().clone()
        for horizon in args.horizons:
            noise = NOISE * torch.randn(horizon, n, env.scene.nu, generator=drawn)
            env.set_state(*start)
            slopes, finer = (differences(env, policy, horizon, noise, size) for size in (SHIFT, SHIFT / 2))
            shift = torch.zeros(n, env.scene.nu, requires_grad=True)
            (each,) = torch.autograd.grad(window(env, policy, horizon, shift, noise).sum(), shift)
            row = {"task": task, "learner": learner, "horizon": horizon, "ground": ground}
            vectors = {"cosine": each.mean(0), "differences": finer}
            row |= {name: float(torch.cosine_similarity(x, slopes, dim=0)) for name, x in vectors.items()}
            yield row | {"norm": float(each.norm(dim=1).median()), "environments": n}


def shown(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy on MuJoCo's contact; no cosine with differences that do not agree."""
    lines = list[Row]()
    hard = [row for row in rows if row["ground"] == "mujoco"]
    for (task, learner), own in grouped(hard, "task", "learner").items():
        agree = [row for row in own if float(row["differences"]) > AGREE]
        cells = {f"cosine, {row['horizon']} steps": row["cosine"] for row in agree}
        lines.append({"task": task, "learner": learner} | {name: cells.get(name, "") for name in SHOWN})
    return lines


def main(args: Args) -> None:
    measured(args, Part("gradients", measure, KEY, "gradients", "transfer.md", shown))


if __name__ == "__main__":
    run(main, Args, __doc__)

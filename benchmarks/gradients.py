"""Whether gradients point where the mean return rises: of every task, on both contacts.

    python benchmarks/gradients.py                                      all tasks, whose robots get noise for actions
    python benchmarks/gradients.py ant go2                              some of them
    python benchmarks/gradients.py runs/learning/ppo_mujoco/*__1        policies, one of each task

A policy acts with noise from states that it visits. The reward of a rollout is differentiated with respect to a shift
of all of the rollout's actions: how well its mean over the environments agrees with differences of the mean reward,
which see jumps that no derivative sees. All begin in one state, with its commands, clocks and random numbers. How far
differences agree among themselves bounds that: by two sizes of the shift, and between two halves of the environments.
The standard error of what they differ by, relative to the differences, tells how much other environments would change.
In float64, tiny differences of single environments, which meet no jump, tell whether the derivative itself is right.
The contacts are the paper's springs, without the robots that have dry friction, MuJoCo's own, and MuJoCo's that begin
over 20 mm. Writes gradients.csv.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import mujoco
import numpy as np
import torch
from common import Part, measured, plot, run
from tables import Row, grouped, numbers
from torch import Tensor

import diffsim
from diffsim import DiffEnv, SceneError
from diffsim.robot.constants import soften
from diffsim.training import Count
from diffsim.training.evaluation import SEED

GROUNDS: dict[str, dict[str, Any]] = {  # by their names in the csv file
    "soft": {"contact": "soft"},
    "mujoco": {"contact": "mujoco"},
    "onset 20 mm": {"contact": "mujoco", "onset": 0.02},
}
ROLLOUTS = 4, 8, 16, 32  # control steps
TINY, FEW = 1e-6, 32  # the shift in float64, and of how many environments at most
NOISE, SHIFT = 0.3, 0.05  # standard deviation of the noise on the actions; their shift in either direction
AGREE, CHANCE = 0.9, 0.5  # the page shows cosines where differences by SHIFT and by half of it agree better than by
# the first, and where the standard error is below the second
KEY = ("task", "learner", "horizon", "ground")
Policy = Callable[[Tensor], Tensor | float]


@dataclass
class Args(common.CheckpointFlags):
    num_envs: Count = 1024  # environments
    horizons: tuple[Count, ...] = ROLLOUTS  # control steps of a rollout
    grounds: tuple[str, ...] = tuple(GROUNDS)  # contacts
    directions: Count = 12  # of the shift, at most: random ones where there are more controls
    warmup: Count = 150  # control steps before the rollout

    @property
    def measured(self) -> tuple[Path, ...]:
        return () if self.draw_only else self.checkpoints or tuple(map(Path, diffsim.TASKS))


def still(obs: Tensor) -> float:
    """The policy of a task that is given without one."""
    return 0.0


def rollout(env: DiffEnv, policy: Policy, horizon: int, shift: Tensor, noise: Tensor) -> Tensor:
    """(N,) rewards of the rollout from where env is; shift (N, nu) and noise (T, N, nu) add to the actions."""
    obs, total = env.detach(), torch.zeros_like(noise[0, :, 0])
    for k in range(horizon):
        obs, reward, *_ = env.step(policy(obs) + shift + noise[k])
        total = total + reward
    return total


def axes(nu: int, most: int) -> Tensor:
    """(K, nu) orthonormal directions of the shift: the controls themselves, or `most` random ones."""
    if nu <= most:
        return torch.eye(nu)
    return torch.linalg.qr(torch.randn(nu, most, generator=torch.Generator().manual_seed(SEED)))[0].T


@torch.no_grad()
def differences(env: DiffEnv, policy: Policy, noise: Tensor, along: Tensor, size: float) -> Tensor:
    """(N, K) central differences of each environment's reward of a rollout, along directions (K, nu) of the shift."""
    start, slopes = env.state_dict(), []
    for direction in along.to(noise):
        ends = []
        for shift in (size * direction, -size * direction):
            env.load_state_dict(start)
            ends.append(rollout(env, policy, len(noise), shift.expand_as(noise[0]), noise))
        slopes.append((ends[0] - ends[1]) / (2 * size))
    env.load_state_dict(start)
    return torch.stack(slopes, dim=1)


def gradient(env: DiffEnv, policy: Policy, noise: Tensor) -> Tensor:
    """(N, nu) derivative of each environment's reward of a rollout with respect to the shift."""
    shift = torch.zeros_like(noise[0], requires_grad=True)
    return torch.autograd.grad(rollout(env, policy, len(noise), shift, noise).sum(), shift)[0]


def error(env: DiffEnv, state: dict[str, Any], policy: Policy, noise: Tensor, along: Tensor) -> float:
    """Median over the environments of env, which is of float64, of the relative error against tiny differences."""
    own, count = env.state_dict(), env.num_envs
    batched = {name: x[:count].to(own[name].dtype) for name, x in state.items() if name not in ("task", "generator")}
    env.load_state_dict(own | batched)
    wide, policy = noise[:, :count].double(), copy.deepcopy(policy)
    if isinstance(policy, torch.nn.Module):
        policy.double()
    expected = differences(env, policy, wide, along, TINY)
    found = gradient(env, policy, wide) @ along.double().T
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1)).nanmedian())


def agreement(each: Tensor, slopes: Tensor, finer: Tensor) -> dict[str, float]:
    """Compare gradients (N, K) with differences of the mean, and these with themselves."""
    mean, coarse, half = each.mean(0), slopes.mean(0), len(slopes) // 2
    pairs = {
        "cosine": (mean, coarse),
        "differences": (finer.mean(0), coarse),
        "halves": (slopes[:half].mean(0), slopes[half:].mean(0)),
    }
    found = {name: float(torch.cosine_similarity(*pair, dim=0)) for name, pair in pairs.items()}
    chance = (each - slopes).std(0).norm() / len(each) ** 0.5  # standard error of the mean of what they differ by
    return found | {"ratio": float(mean.norm() / coarse.norm()), "chance": float(chance / coarse.norm())}


def measure(args: Args, path: Path) -> Iterator[Row]:
    """Rows of one policy, or of one task."""
    task, learner, policy, n = str(path), "noise", still, args.num_envs
    if task not in diffsim.TASKS:
        case = common.load_case(path, 1, "cpu")
        task, learner, policy = case.env.task.name, case.saved.script, case.saved.network
    for ground in args.grounds:
        options: dict[str, Any] = {
            "horizon": max(args.horizons),
            "early_termination": False,
            "max_episode_steps": 10**9,
        }
        options |= GROUNDS[ground]
        try:
            env = diffsim.make(task, n, **options)  # in which no episode ends: a reset within a rollout is no slope
            exact = diffsim.make(task, min(n, FEW), **options, dtype=torch.float64, tolerance=1e-10)
        except SceneError as refusal:
            print(f"  {str(refusal).partition(' (')[0]}")
            continue
        env.reset(seed=SEED)
        drawn = torch.Generator().manual_seed(SEED)
        noise = NOISE * torch.randn(args.warmup, n, env.scene.nu, generator=drawn)
        with torch.no_grad():
            rollout(env, policy, args.warmup, torch.zeros(n, env.scene.nu), noise)
        start, along = env.state_dict(), axes(env.scene.nu, args.directions)
        for horizon in args.horizons:
            noise = NOISE * torch.randn(horizon, n, env.scene.nu, generator=drawn)
            env.load_state_dict(start)
            slopes, finer = (differences(env, policy, noise, along, size) for size in (SHIFT, SHIFT / 2))
            each = gradient(env, policy, noise)
            row = {"task": task, "learner": learner, "horizon": horizon, "ground": ground}
            row |= agreement(each @ along.T, slopes, finer)
            row["error"] = error(exact, start, policy, noise, along[:4])
            yield row | {"norm": float(each.norm(dim=1).median()), "environments": n}


def shown(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy on each of MuJoCo's; no cosine that chance decides, or of differences that disagree."""
    lines = list[Row]()
    hard = [row for row in rows if row["ground"] != "soft"]
    for (task, learner, ground), own in grouped(hard, "task", "learner", "ground").items():
        sure = [row for row in own if float(row["differences"]) > AGREE and float(row.get("chance") or 0) < CHANCE]
        if not sure:
            continue
        cosines = {int(row["horizon"]): row["cosine"] for row in sure}
        ratios = {int(row["horizon"]): row.get("ratio", "") for row in sure}
        line = {f"cosine, {k} steps": cosines.get(k, "") for k in ROLLOUTS}
        name = ", ".join((task, *(x for x in (learner, ground) if x not in ("noise", "mujoco"))))
        lines.append({"task": name} | line | {"ratio, 8 steps": ratios.get(8, "")})
    return lines


LOOKS = ("C3o-", "mujoco"), ("C0o-", "onset 20 mm")
POOR = 0.95  # the picture has tasks with a cosine below
BALL = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 0.1"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""


def force(heights: np.ndarray, onset: float) -> list[float]:
    """MuJoCo's force on a ball of 1 kg at rest [N], its lowest point at `heights` [m], by an onset [m]."""
    model = mujoco.MjModel.from_xml_string(BALL)
    model.geom_solimp[:] = [soften(row, onset) for row in model.geom_solimp]
    data, found = mujoco.MjData(model), []
    for height in heights:
        data.qpos[2] = 0.1 + height
        mujoco.mj_forward(model, data)
        found.append(float(data.qfrc_constraint[2]))
    return found


def panels(rows: list[dict[str, str]]) -> list[common.Panel]:
    """What a soft onset does to the force, and to the gradients of rollouts where they need it."""
    height = np.linspace(0.002, -0.02, 221)
    looks = {"C3-": 0.0, "C1-": 0.005, "C0-": 0.02}
    balls = [
        common.Line(1e3 * height, force(height, m), look, f"{1e3 * m:g} mm" if m else "the file's default")
        for look, m in looks.items()
    ]
    found = [common.Panel(balls, "", "lowest point of a ball [mm]", "force [N]")]
    for (task,), own in grouped([row for row in rows if row["learner"] == "noise"], "task").items():
        if any(row["ground"] == "onset 20 mm" for row in own) and min(numbers(own, "cosine")) < POOR:
            drawn = [(look, [row for row in own if row["ground"] == name]) for look, name in LOOKS]
            curves = [common.Line(numbers(some, "horizon"), numbers(some, "cosine"), look) for look, some in drawn]
            found.append(common.Panel(curves, task, "steps of a rollout", "cosine with differences"))
    return found


def main(args: Args) -> None:
    common.check_names("--grounds", args.grounds, GROUNDS)
    rows = measured(args, Part("gradients", measure, KEY, "gradients", "transfer.md", shown))
    plot(args.picture("onset"), [panels(rows)], (3.4, 2.6))


if __name__ == "__main__":
    run(main, Args, __doc__)

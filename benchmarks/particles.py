"""Figure 11 of the PFPN paper: which peaks of a reward a policy covers, on a bandit with two equal ones.

    python benchmarks/particles.py                       ten minutes of a CPU
    python benchmarks/particles.py --parts noise         how much resampling changes a policy, by its noise

Writes bandit.csv (each policy's actions near the peaks) and resampling_noise.csv, and with --update-results the tables
of docs/pfpn.md. PPO trains all policies with one setting. The Gaussian's standard deviation begins at 0.37.
"""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass
from itertools import product
from statistics import mean
from types import SimpleNamespace
from typing import Any, Literal

import torch
from common import CommonFlags, run
from groups import grouped, numbers
from tables import ROOT, Row, markdown
from torch import Tensor

sys.path.append(str(ROOT))
import pfpn  # noqa: E402
from diffsim.training import parse  # noqa: E402

PartName = Literal["peaks", "noise"]
PEAKS, NEAR = (-0.25, 0.75), 0.15
POLICIES = ("pfpn", "gaussian", "gmm", "discrete")
SETTING = "--env ant --device cpu --horizon 1 --hidden 1 --minibatch-size 256 --epochs 4 --std own "
SETTING += "--lr 3e-3 --lr-bounds 3e-3 3e-3 --resampling-noise 1"
NOISES = (0.0, 0.1, 0.3, 1.0)  # standard deviations
CASES = {"0": (150, 500), "0.2": (150, 500)}  # entropy's weight: iterations of 256 actions each
SAMPLES = 20_000  # actions of a trained policy
CASE = ("policy", "entropy's weight", "iterations")


@dataclass
class Args(CommonFlags):
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)  # seeds of the bandit
    parts: tuple[PartName, ...] = ("peaks", "noise")  # what to measure


class Bandit:
    """An environment whose episodes are one action: 1 / (d + 0.1), of the distance d to the nearest peak."""

    num_envs, device = 256, torch.device("cpu")
    scene, task = SimpleNamespace(nu=1), SimpleNamespace(obs_dim=1)

    def detach(self) -> Tensor:
        return torch.zeros(256, 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        obs, yes = torch.zeros(256, 1), torch.ones(256, dtype=torch.bool)
        return obs, reward(action.clamp(-1, 1)).squeeze(1), yes, ~yes, {"final_obs": obs}


def reward(action: Tensor) -> Tensor:
    return 1 / (torch.stack([(action - peak).abs() for peak in PEAKS]).amin(0) + 0.1)


def learner_of(seed: int, *flags: str) -> pfpn.PPO:
    torch.manual_seed(seed)
    bandit: Any = Bandit()
    return pfpn.PPO(parse(pfpn.Args, [*SETTING.split(), *flags]), bandit)


def learn(policy: str, entropy: str, seed: int) -> dict[int, Tensor]:
    """Actions (SAMPLES,) of the policy after each number of iterations."""
    learner = learner_of(seed, "--policy", policy, "--entropy-coef", entropy)
    if policy == "gaussian":
        learner.actor.head.log_std.data.fill_(-1.0)
    drawn = dict[int, Tensor]()
    for iteration in range(1, max(CASES[entropy]) + 1):
        learner.interact()
        learner.learn()
        if iteration in CASES[entropy]:
            with torch.no_grad():
                drawn[iteration] = learner.actor(torch.zeros(SAMPLES, 1))[0].sample().squeeze(1).clamp(-1, 1)
    return drawn


def measure(args: Args) -> None:
    for policy, (entropy, marks) in product(POLICIES, CASES.items()):
        runs = [learn(policy, entropy, seed) for seed in args.seeds]
        for mark in marks:
            case = dict[str, object](zip(CASE, (policy, entropy, mark), strict=True))
            each = [drawn[mark] for drawn in runs]
            near = [[((x - peak).abs() < NEAR).double().mean().item() for x in each] for peak in PEAKS]
            both = sum(min(pair) > 0.1 for pair in zip(*near, strict=True))
            shares = {f"near {peak}": " ".join(f"{x:.2f}" for x in own) for peak, own in zip(PEAKS, near, strict=True)}
            average = reward(torch.stack(each)).mean().item()
            row = case | shares | {"both": f"{both} of {len(each)}", "mean reward": f"{average:.2f}"}
            args.keep("bandit", row, CASE)


def density(learner: pfpn.PPO) -> Tensor:
    """(20001,) of actions from -2 to 2."""
    with torch.no_grad():
        mixture, _ = learner.actor(torch.zeros(1, 1))
        return mixture.log_density(torch.linspace(-2, 2, 20_001).unsqueeze(-1)).exp().squeeze(-1)


def disturb(args: Args) -> None:
    """Resample a policy that was trained without, at each noise: how far its density moves, in total variation."""
    for seed in args.seeds:
        learner = learner_of(seed, "--resampling", "none", "--resampling-interval", "1")
        for _ in range(min(CASES["0"])):
            learner.interact()
            learner.learn()
        learner.interact()
        before = density(learner)
        for noise in NOISES:
            other = copy.deepcopy(learner)
            other.args.resampling, other.args.resampling_noise = "weighted", noise
            found = other.resampling.end_iteration(other.actor.head, other.optimizer)
            change = (density(other) - before).abs().sum().item() * 4 / 20_000 / 2
            row = {"noise": noise, "seed": seed, "moved": int(found["particles/moved"]), "total variation": change}
            args.keep("resampling_noise", row, ("noise", "seed"))


def means(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each noise: means over the seeds."""
    found = list[Row]()
    for (noise,), own in grouped(rows, "noise").items():
        moved, change = (mean(numbers(own, name)) for name in ("moved", "total variation"))
        found.append({"standard deviations": noise, "particles moved": moved, "change of the policy": change})
    return found


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy: how many seeds have actions near both peaks, by entropy's weight and iterations."""
    _, entropy, iterations = CASE
    groups = grouped(rows, "policy").items()
    return [{"policy": name} | {f"{r[entropy]}, {r[iterations]}": r["both"] for r in own} for (name,), own in groups]


def main(args: Args) -> None:
    if not args.draw_only and "peaks" in args.parts:
        measure(args)
    if not args.draw_only and "noise" in args.parts:
        disturb(args)
    args.publish("bandit", markdown(table(args.read("bandit"))), "pfpn.md")
    args.publish("noise", markdown(means(args.read("resampling_noise"))), "pfpn.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

"""Figure 11 of the PFPN paper: which peaks of a reward a policy covers, on a bandit with two equal ones.

    python benchmarks/particles.py                       ten minutes of a CPU

Writes bandit.csv (each policy's actions near the peaks) and, with --update-results, the table of docs/pfpn.md. PPO
trains all policies with one setting. The Gaussian's standard deviation begins at 0.37.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product
from types import SimpleNamespace
from typing import Any

import torch
from common import CommonFlags, run
from tables import ROOT, Row, grouped, markdown
from torch import Tensor

sys.path.append(str(ROOT))
import pfpn  # noqa: E402
from diffsim.training import parse  # noqa: E402

PEAKS, NEAR = (-0.25, 0.75), 0.15
POLICIES = ("pfpn", "gaussian", "gmm", "discrete")
SETTING = "--env ant --device cpu --horizon 1 --hidden 1 --minibatch-size 256 --epochs 4 --std own "
SETTING += "--lr 3e-3 --lr-bounds 3e-3 3e-3 --resampling-noise 1"
CASES = {"0": (150, 500), "0.2": (150, 500)}  # entropy's weight: iterations of 256 actions each
SAMPLES = 20_000  # actions of a trained policy
CASE = ("policy", "entropy's weight", "iterations")


@dataclass
class Args(CommonFlags):
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)  # seeds of the bandit


class Bandit:
    """An environment whose episodes are one action: 1 / (d + 0.1), of the distance d to the nearest peak."""

    num_envs, device = 256, torch.device("cpu")
    scene, task = SimpleNamespace(nu=1), SimpleNamespace(obs_dim=1, actor_dim=None)

    def detach(self) -> Tensor:
        return torch.zeros(256, 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        obs, yes = torch.zeros(256, 1), torch.ones(256, dtype=torch.bool)
        return obs, reward(action.clamp(-1, 1)).squeeze(1), yes, ~yes, {"final_obs": obs}


def reward(action: Tensor) -> Tensor:
    return 1 / (torch.stack([(action - peak).abs() for peak in PEAKS]).amin(0) + 0.1)


def learn(policy: str, entropy: str, seed: int) -> dict[int, Tensor]:
    """Actions (SAMPLES,) of the policy after each number of iterations."""
    torch.manual_seed(seed)
    bandit: Any = Bandit()
    flags = [*SETTING.split(), "--policy", policy, "--entropy-coef", entropy]
    learner = pfpn.PPO(parse(pfpn.Args, flags), bandit)
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


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy: how many seeds have actions near both peaks, by entropy's weight and iterations."""
    _, entropy, iterations = CASE
    groups = grouped(rows, "policy").items()
    return [{"policy": name} | {f"{r[entropy]}, {r[iterations]}": r["both"] for r in own} for (name,), own in groups]


def main(args: Args) -> None:
    if not args.draw_only:
        measure(args)
    args.publish("bandit", markdown(table(args.read("bandit"))), "pfpn.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

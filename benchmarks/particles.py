"""Figures 11 and 6 of the PFPN paper: which peaks of a reward a policy covers, and where particles go while it learns.

    python benchmarks/particles.py                       a bandit with two equal peaks; ten minutes of a CPU
    python benchmarks/particles.py --run <directory>     a run of pfpn.py instead, trained with --log-particles

Writes bandit.csv (each policy's actions near the peaks), particles.csv and particles.png (locations and weights of the
first seed's particles, or of the run's), and with --update-results the table of docs/pfpn.md. PPO trains all
policies with one setting. The Gaussian's standard deviation begins at 0.37.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from common import CommonFlags, Line, Panel, parse, plot
from tables import ROOT, markdown, read_csv
from torch import Tensor

from diffsim.training import command, fail

sys.path.append(str(ROOT))
import pfpn  # noqa: E402

PEAKS, NEAR = (-0.25, 0.75), 0.15
POLICIES = ("pfpn", "gaussian", "gmm", "discrete")
SETTING = "--env ant --device cpu --horizon 1 --hidden 1 --minibatch-size 256 --epochs 4 --lr 3e-3 --log-particles 0"
CASES = {"0": (150, 500), "0.2": (150, 500)}  # entropy's weight: iterations of 256 actions each
SAMPLES = 20_000  # actions of a trained policy
POINTS = 60  # iterations kept of particles.csv
CASE = ("policy", "entropy's weight", "iterations")
Rows = list[dict[str, object]]


@dataclass
class Args(CommonFlags):
    run: Path | None = None  # directory of a run of pfpn.py, trained with --log-particles, whose particles are drawn
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)  # seeds of the bandit


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


def learn(policy: str, entropy: str, seed: int) -> tuple[dict[int, Tensor], list[dict[str, str]]]:
    """Actions (SAMPLES,) of the policy after each number of iterations, and what it logged of its particles."""
    args = pfpn.parse(pfpn.Args, [*SETTING.split(), "--policy", policy, "--entropy-coef", entropy])
    torch.manual_seed(seed)
    bandit: Any = Bandit()
    learner = pfpn.PPO(args, bandit)
    learner.lr_bounds = (args.lr, args.lr)
    if policy == "gaussian":
        learner.actor.head.log_std.data.fill_(-1.0)
    drawn, log = dict[int, Tensor](), list[dict[str, str]]()
    for iteration in range(1, max(CASES[entropy]) + 1):
        found = learner.interact() | learner.learn()
        particles = {name.replace("/", "_"): f"{float(x):.6g}" for name, x in found.items() if "particles/" in name}
        log.append({"iteration": str(iteration)} | particles)
        if iteration in CASES[entropy]:
            with torch.no_grad():
                drawn[iteration] = pfpn.sample(learner.actor(torch.zeros(SAMPLES, 1)))[0].squeeze(1).clamp(-1, 1)
    return drawn, log


def paths(log: Sequence[dict[str, str]]) -> Rows:
    """Rows of particles.csv, of some iterations of progress.csv."""
    keep = np.linspace(0, len(log) - 1, min(POINTS, len(log))).round().astype(int)
    rows = Rows()
    for row in (log[k] for k in keep):
        for name in (name for name in row if name.startswith("particles_loc_")):
            action, particle = name.split("_")[2:]
            where = {"iteration": row["iteration"], "action": action, "particle": particle}
            rows.append({**where, "location": row[name], "weight": row[name.replace("loc", "weight")]})
    return rows


def measure(args: Args) -> None:
    rows = Rows()
    for policy, (entropy, marks) in product(POLICIES, CASES.items()):
        runs = [learn(policy, entropy, seed) for seed in args.seeds]
        if (policy, entropy) == (POLICIES[0], max(CASES)):
            args.write("particles", paths(runs[0][1]))
        for mark in marks:
            case = dict[str, object](zip(CASE, (policy, entropy, mark), strict=True))
            each = [drawn[mark] for drawn, _ in runs]
            near = [[((x - peak).abs() < NEAR).double().mean().item() for x in each] for peak in PEAKS]
            both = sum(min(pair) > 0.1 for pair in zip(*near, strict=True))
            shares = {f"near {peak}": " ".join(f"{x:.2f}" for x in own) for peak, own in zip(PEAKS, near, strict=True)}
            mean = reward(torch.stack(each)).mean().item()
            rows.append(case | shares | {"both": f"{both} of {len(each)}", "mean reward": f"{mean:.2f}"})
            print("  " + ", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    args.write("bandit", rows)


def table(rows: Sequence[dict[str, str]]) -> str:
    """A line for each policy: how many seeds have actions near both peaks, by entropy's weight and iterations."""
    found: dict[str, dict[str, object]] = {}
    for row in rows:
        policy, entropy, iterations = (row[name] for name in CASE)
        found.setdefault(policy, {"policy": policy})[f"{entropy}, {iterations}"] = row["both"]
    return markdown(list(found.values()))


def draw(args: Args) -> None:
    """A line for each particle, against iterations: its location and its weight."""
    actions: dict[str, dict[str, list[dict[str, str]]]] = {}
    for row in args.read("particles"):
        actions.setdefault(row["action"], {}).setdefault(row["particle"], []).append(row)
    grid = list[list[Panel]]()
    for y in ("location", "weight"):
        panels = list[Panel]()
        for action, particles in actions.items():
            points = [np.array([(float(row["iteration"]), float(row[y])) for row in own]) for own in particles.values()]
            lines = [Line(x[:, 0], x[:, 1], f"C{k % 10}-", width=0.8) for k, x in enumerate(points)]
            panels.append(Panel(lines, f"action {action}", "iteration", y))
        grid.append(panels)
    plot(args.picture("particles"), grid)


@command
def main(args: Args) -> None:
    if args.run and not args.draw_only:
        if not (found := paths(read_csv(args.run / "progress.csv"))):
            fail(f"{args.run}: no progress.csv of a run of pfpn.py with --log-particles")
        args.write("particles", found)
    elif not args.draw_only:
        measure(args)
    draw(args)
    args.publish("bandit", table(args.read("bandit")), "pfpn.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))

"""Figures 11 and 6 of the PFPN paper: which peaks of a reward a policy covers, and where particles go while it learns.

    python benchmarks/particles.py                       a bandit with two equal peaks; ten minutes of a CPU
    python benchmarks/particles.py --run <directory>     a run of pfpn.py instead, trained with --log-particles
    python benchmarks/particles.py --resample <run>      what one resampling does to the return of a trained policy

Writes bandit.csv (each policy's actions near the peaks), bandit_density.csv and particles.csv (locations and weights
of the first seed's particles, or of the run's), a picture of each, and with --update-results the table of docs/pfpn.md;
with --resample resampling.csv and its table instead. PPO trains all policies with one setting. The Gaussian's standard
deviation begins at 0.37.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from common import CommonFlags, Line, Panel, checkpoint_of, parse, plot
from tables import ROOT, markdown, read_csv
from torch import Tensor, nn

from diffsim.training import Count, Fraction, checkpoint, evaluate, fail
from diffsim.training.assess import make_env

sys.path.append(str(ROOT))
import pfpn  # noqa: E402

PEAKS, NEAR = (-0.25, 0.75), 0.15
POLICIES = ("pfpn", "gaussian", "gmm", "discrete")
SETTING = "--env ant --device cpu --horizon 1 --hidden 1 --minibatch-size 256 --epochs 4 --lr 3e-3 --log-particles 0"
CASES = (("0", 150), ("0", 500), ("0.2", 150), ("0.2", 500))  # entropy's weight, iterations of 256 actions each
SAMPLES, BINS = 20_000, 50  # actions of a trained policy, and of their histogram
POINTS = 60  # iterations kept of particles.csv
Log = list[dict[str, str]]


@dataclass
class Args(CommonFlags):
    run: Path | None = None  # directory of a run of pfpn.py, trained with --log-particles, whose particles are drawn
    resample: tuple[Path, ...] = ()  # checkpoints of pfpn.py, or its runs, that are resampled once
    dead: tuple[Fraction, ...] = (
        0.05,
        0.2,
        0.5,
    )  # thresholds of a resampling; pfpn.py's default first
    episodes: Count = 256  # before it and after it
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)  # seeds of the bandit


class Bandit:
    """An environment whose episodes are one action: 1 / (d + 0.1), of the distance d to the nearest peak."""

    num_envs, episode_length, device = 256, 1, torch.device("cpu")
    scene, task = SimpleNamespace(nu=1), SimpleNamespace(obs_dim=1)
    sim = SimpleNamespace(nonfinite_gradients=torch.zeros(256))

    def detach(self) -> Tensor:
        return torch.zeros(256, 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        r, yes = reward(action.clamp(-1, 1)).squeeze(1), torch.ones(256, dtype=torch.bool)
        info = {"final_obs": torch.zeros(256, 1), "nonfinite": ~yes, "episode": {"r": r, "l": torch.ones(256)}}
        return torch.zeros(256, 1), r, yes, ~yes, info


def reward(action: Tensor) -> Tensor:
    return 1 / (torch.stack([(action - peak).abs() for peak in PEAKS]).amin(0) + 0.1)


def learn(policy: str, entropy: str, seed: int, marks: Sequence[int]) -> tuple[dict[int, Tensor], Log]:
    """Actions (SAMPLES,) of the policy after so many iterations, and what it logged of its particles."""
    args = pfpn.parse(pfpn.Args, [*SETTING.split(), "--policy", policy, "--entropy-coef", entropy])
    torch.manual_seed(seed)
    bandit: Any = Bandit()
    learner = pfpn.PPO(args, bandit)
    learner.lr_bounds = (args.lr, args.lr)
    if isinstance(learner.actor.head, pfpn.Gaussian):
        nn.init.constant_(learner.actor.head.get_parameter("log_std"), -1.0)
    drawn, log = dict[int, Tensor](), Log()
    for iteration in range(1, max(marks) + 1):
        found = learner.interact() | learner.learn()
        particles = {name.replace("/", "_"): f"{float(x):.6g}" for name, x in found.items() if "particles/" in name}
        log.append({"iteration": str(iteration)} | particles)
        if iteration in marks:
            with torch.no_grad():
                drawn[iteration] = learner.actor(torch.zeros(SAMPLES, 1)).sample().squeeze(1).clamp(-1, 1)
    return drawn, log


def paths(log: Log) -> list[dict[str, object]]:
    """Rows of particles.csv, of some iterations of progress.csv."""
    keep = np.linspace(0, len(log) - 1, min(POINTS, len(log))).round().astype(int)
    rows = list[dict[str, object]]()
    for row in (log[k] for k in keep):
        for name in (name for name in row if name.startswith("particles_loc_")):
            action, particle = name.split("_")[2:]
            where = {"iteration": row["iteration"], "action": action, "particle": particle}
            rows.append(where | {"location": row[name], "weight": row[name.replace("loc", "weight")]})
    return rows


def measure(args: Args) -> None:
    rows, densities = [], []
    for policy, entropy in product(POLICIES, dict.fromkeys(entropy for entropy, _ in CASES)):
        marks = [iterations for other, iterations in CASES if other == entropy]
        runs = [learn(policy, entropy, seed, marks) for seed in args.seeds]
        if (policy, entropy) == (POLICIES[0], CASES[-1][0]):
            args.write("particles", paths(runs[0][1]))
        for mark in marks:
            each = [drawn[mark] for drawn, _ in runs]
            near = [[((x - peak).abs() < NEAR).double().mean().item() for x in each] for peak in PEAKS]
            case: dict[str, object] = {"policy": policy, "entropy's weight": entropy, "iterations": mark}
            for seed, x in zip(args.seeds, each, strict=True):
                heights, edges = np.histogram(x.numpy(), BINS, (-1, 1), density=True)
                for place, height in zip((edges[:-1] + edges[1:]) / 2, heights, strict=True):
                    densities.append(case | {"seed": seed, "action": f"{place:.2f}", "density": f"{height:.3f}"})
            both = sum(min(pair) > 0.1 for pair in zip(*near, strict=True))
            shares = {f"near {peak}": " ".join(f"{x:.2f}" for x in own) for peak, own in zip(PEAKS, near, strict=True)}
            mean = reward(torch.stack(each)).mean().item()
            rows.append(case | shares | {"both": f"{both} of {len(each)}", "mean reward": f"{mean:.2f}"})
            print("  " + ", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    args.write("bandit", rows)
    args.write("bandit_density", densities)


def resample(path: Path, dead: float, args: Args) -> dict[str, object]:
    """Returns of the policy with its noise before and after a resampling by the weights that were seen before it."""
    path = checkpoint_of(path)
    state = checkpoint.load(path, "pfpn")
    flags = ["--device", args.device, "--resampling-interval", "1", "--dead", str(dead)]
    settings = pfpn.parse(pfpn.Args, ["--evaluate", str(path), *flags])
    if settings.policy != "pfpn":
        fail(f"{path} has a policy without particles to resample: --policy {settings.policy}")
    env = make_env(settings, args.episodes)
    learner = pfpn.ALGORITHMS[settings.algorithm](settings, env)
    checkpoint.restore(learner, state)
    learner.resampling.total.zero_()
    returns = list[Tensor]()
    for _ in range(2):
        torch.manual_seed(0)
        returns.append(evaluate(env, lambda obs: learner.act(obs)[0]).returns.double())
        if len(returns) == 1:
            moved = float(learner.resampling.moved)
            found = learner.resampling.end_iteration(learner.actor.head, learner.optimizer)
    error = math.sqrt(sum(float(x.var()) for x in returns) / args.episodes)  # of the difference
    row: dict[str, object] = {"task": settings.env, "algorithm": settings.algorithm, "seed": settings.seed}
    row |= {"iteration": state["iteration"], "threshold": dead, "moved": float(found["particles/moved"]) - moved}
    row |= {
        "of": learner.resampling.total.numel(),
        "before": returns[0].mean().item(),
        "after": returns[1].mean().item(),
    }
    return row | {"standard error of the difference": error}


def panel(rows: Sequence[dict[str, str]], each: str, x: str, y: str, title: str) -> Panel:
    """A line for each value of a column."""
    lines = list[Line]()
    for key in dict.fromkeys(row[each] for row in rows):
        points = np.array([(float(row[x]), float(row[y])) for row in rows if row[each] == key])
        lines.append(Line(points[:, 0], points[:, 1], f"C{len(lines) % 10}-", width=0.8))
    return Panel(lines, title, x, y)


def draw(args: Args) -> None:
    found, titles = args.read("bandit_density"), ("policy", "entropy's weight", "iterations")
    cases: dict[str, list[dict[str, str]]] = {}
    for row in found:
        cases.setdefault(", ".join(row[name] for name in titles), []).append(row)
    names = [[f"{p}, {entropy}, {mark}" for p in POLICIES] for entropy, mark in (CASES[0], CASES[-1]) if found]
    grid = [[panel(cases[name], "seed", "action", "density", name) for name in row] for row in names]
    plot(args.picture("bandit"), grid or [[]])
    actions: dict[str, list[dict[str, str]]] = {}
    for row in args.read("particles"):
        actions.setdefault(row["action"], []).append(row)
    places = ("location", "weight")
    grid = [[panel(own, "particle", "iteration", y, f"action {k}") for k, own in actions.items()] for y in places]
    plot(args.picture("particles"), grid)


def main(args: Args) -> None:
    if args.resample:
        rows = [resample(path, dead, args) for path, dead in product(args.resample, args.dead)]
        found = args.merge("resampling", rows, ("task", "algorithm", "seed", "threshold"))
        return args.publish("resampled", markdown(found), "pfpn.md")
    if args.run and not args.draw_only:
        if not (rows := paths(read_csv(args.run / "progress.csv"))):
            fail(f"{args.run}: no progress.csv of a run of pfpn.py with --log-particles")
        args.write("particles", rows)
    elif not args.draw_only:
        measure(args)
    draw(args)
    pictures = "".join(f"![{name}]({args.link(name)})\n" for name in ("bandit", "particles"))
    args.publish("bandit", f"{markdown(args.read('bandit'))}\n{pictures}", "pfpn.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))

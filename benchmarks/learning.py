"""Learning curves: runs a learner on tasks and seeds, evaluates the final policies, and draws and tabulates all of it.

    python benchmarks/learning.py --env ant --seeds 1 2 3              train (finished runs are kept), evaluate, draw
    python benchmarks/learning.py --collect-only                       only draw and tabulate what there is
    python benchmarks/learning.py --runs runs/short -- --iterations 50 what follows "--" goes to the learner

Writes docs/results/{algorithm}_{env}.csv (about 100 points of each run), docs/results/{algorithm}_summary.csv,
docs/results/{algorithm}.md and docs/{algorithm}.png. An interrupted run is resumed from its checkpoint.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any, NoReturn

import matplotlib
import numpy as np
import tyro

import diffsim

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = ("iteration", "control_steps", "seconds", "return", "length", "eval_return")
POINTS = 100  # kept of each run

# Returns whose first passing is timed, and SHAC's published return on these tasks (Georgiev et al. 2024, "Adaptive
# Horizon Actor-Critic": 10 seeds, best point of the curve); nobody has published cartpole and half_cheetah.
THRESHOLDS = {
    "cartpole": (-1000, -520),
    "hopper": (3000, 4500),
    "half_cheetah": (),
    "ant": (5000, 7300, 7661),
    "humanoid": (5000, 7000, 8387),
    "humanoid_mtu": (4246, 6964),
}
PUBLISHED = {"hopper": 4837, "ant": 7661, "humanoid": 8387, "humanoid_mtu": 6114}


@dataclass
class Args:
    algorithm: str = "shac"
    """learner: the name of a script in the repository's root, without .py"""
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = tuple(diffsim.TASKS)
    """tasks"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of each task"""
    jobs: int = 1
    """runs at a time; the CPU's cores are split among them, which slows each of them down"""
    arguments: tyro.conf.Suppress[tuple[str, ...]] = ()
    finer: int = 4
    """the final policies are evaluated a second time with this many times the substeps"""
    runs: Path = ROOT / "runs" / "learning"
    """directory of the runs: {runs}/{algorithm}/{env}__{seed}"""
    docs: Path = ROOT / "docs"
    """directory of what is written"""
    collect_only: bool = False
    """train and evaluate nothing"""


# Runs -----------------------------------------------------------------------------------------------------------------


def learner(args: Args, *arguments: object) -> list[str]:
    command = [sys.executable, str(ROOT / f"{args.algorithm}.py"), *map(str, arguments)]
    if args.jobs > 1:
        command += ["--threads", str(max(1, len(os.sched_getaffinity(0)) // args.jobs))]
    return command


def run_dir(args: Args, env: str, seed: int) -> Path:
    return args.runs / args.algorithm / f"{env}__{seed}"


def trained(folder: Path) -> bool:
    """Whether the run has reached its last iteration, and saved it."""
    if not (folder / "checkpoint.pt").exists():
        return False
    done = read_csv(folder / "progress.csv")[-1]["iteration"]
    return int(done) >= json.loads((folder / "args.json").read_text())["iterations"]


def train(args: Args, env: str, seed: int) -> None:
    """One run from where it stands to its evaluation; `evaluation.json` marks it as finished."""
    folder = run_dir(args, env, seed)
    if (folder / "evaluation.json").exists():
        print(f"{env}, seed {seed}: finished before", flush=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / "checkpoint.pt"
    start = ("--resume", checkpoint) if checkpoint.exists() else ("--env", env, "--seed", seed, "--run-dir", folder)
    if not trained(folder):
        with (folder / "output.txt").open("a") as output:
            command = learner(args, *start, "--quiet", *args.arguments)
            if subprocess.run(command, stdout=output, stderr=output).returncode != 0:
                print(f"{env}, seed {seed}: failed or interrupted, see {output.name}", flush=True)
                return
    substeps = json.loads((folder / "args.json").read_text())["substeps"] or diffsim.TASKS[env].substeps
    returns = {}
    for key, count in (("own", substeps), ("finer", args.finer * substeps)):
        command = learner(args, "--evaluate", checkpoint, "--substeps", count)
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        found = re.search(r"return median (-?[\d.]+)", text)
        if not found:
            raise RuntimeError(f"no 'return median <number>' in the output of {shlex.join(command)}: {text}")
        returns[key] = float(found[1])
    evaluation = {"substeps": substeps, "finer_substeps": args.finer * substeps, **returns}
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    print(f"{env}, seed {seed}: {evaluation}", flush=True)


# Collecting -----------------------------------------------------------------------------------------------------------

Curve = dict[str, np.ndarray]


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def number(text: str) -> float:
    return float(text) if text else float("nan")


def subsample(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """About POINTS rows, evenly spread, and every row that has an evaluation."""
    keep = set(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int))
    return [row for k, row in enumerate(rows) if k in keep or row["eval_return"]]


def collect(args: Args, env: str) -> dict[str, Any] | None:
    """Writes the task's csv and returns its row of the summary; None where there is no run."""
    points, final, finer, passed, substeps = [], [], [], {t: [] for t in THRESHOLDS.get(env, ())}, ""
    seeds = []
    for folder in sorted((args.runs / args.algorithm).glob(f"{env}__*"), key=lambda p: int(p.name.split("__")[1])):
        if not (folder / "evaluation.json").exists():
            continue
        seed, progress = folder.name.split("__")[1], read_csv(folder / "progress.csv")
        seeds.append(seed)
        points += [{"seed": seed} | {c: short(row[c]) for c in COLUMNS} for row in subsample(progress)]
        evaluation = json.loads((folder / "evaluation.json").read_text())
        final.append(evaluation["own"])
        finer.append(evaluation["finer"])
        substeps = f"{evaluation['substeps']} / {evaluation['finer_substeps']}"
        for threshold, seconds in passed.items():
            times = [number(r["seconds"]) for r in progress if r["return"] and float(r["return"]) >= threshold]
            seconds.append(times[0] if times else float("inf"))
    if not points:
        return None
    write_csv(args.docs / "results" / f"{args.algorithm}_{env}.csv", points)
    last = {row["seed"]: row for row in points}.values()
    kept = median(finer) / median(final)
    if median(final) < 0:
        kept = 1 / kept
    return {
        "task": env,
        "seeds": " ".join(seeds),
        "return": f"{median(final):.0f}",
        "each seed": " ".join(f"{r:.0f}" for r in final),
        "published SHAC": PUBLISHED.get(env, ""),
        "training": f"{median(float(row['seconds']) for row in last):.0f} s",
        "return passes, median over seeds": "; ".join(
            f"{t} after {median(s):.0f} s" if median(s) < float("inf") else f"{t} not" for t, s in passed.items()
        ),
        "substeps": substeps,
        "return at the finer": f"{median(finer):.0f}",
        "kept": f"{kept:.3f}",
    }


def short(text: str) -> str:
    return f"{float(text):.6g}" if text else ""


def summarise(args: Args, rows: list[dict[str, Any]]) -> None:
    """Merges the rows into the summary and prints and writes it as markdown."""
    path = args.docs / "results" / f"{args.algorithm}_summary.csv"
    merged = {row["task"]: row for row in read_csv(path)} if path.is_file() else {}
    merged |= {row["task"]: row for row in rows}
    table = [merged[env] for env in diffsim.TASKS if env in merged]
    write_csv(path, table)
    columns = list(table[0])
    lines = [columns, ["---"] * len(columns), *([str(row[c]) for c in columns] for row in table)]
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    (args.docs / "results" / f"{args.algorithm}.md").write_text(text)
    print(text, end="")


# Drawing --------------------------------------------------------------------------------------------------------------


def curves(path: Path) -> list[Curve]:
    """Of each seed the columns as arrays, from the first finished episode on."""
    seeds: dict[str, list[dict[str, str]]] = {}
    for row in read_csv(path):
        if row["return"]:
            seeds.setdefault(row["seed"], []).append(row)
    return [{c: np.array([number(row[c]) for row in rows]) for c in COLUMNS} for rows in seeds.values()]


def median_curve(runs: list[Curve], x: str) -> tuple[np.ndarray, np.ndarray]:
    """The median over seeds on a common grid that every run reaches."""
    grid = np.linspace(max(r[x][0] for r in runs), min(r[x][-1] for r in runs), 200)
    return grid, np.median([np.interp(grid, r[x], r["return"]) for r in runs], axis=0)


def draw(args: Args) -> None:
    paths = {env: args.docs / "results" / f"{args.algorithm}_{env}.csv" for env in diffsim.TASKS}
    tasks = {env: curves(path) for env, path in paths.items() if path.is_file()}
    figure, axes = plt.subplots(2, len(tasks), figsize=(3.4 * len(tasks), 5.2), squeeze=False, layout="constrained")
    for column, (env, runs) in enumerate(tasks.items()):
        for axis, x, scale, label in (
            (axes[0, column], "seconds", 1.0, "wall seconds of training"),
            (axes[1, column], "control_steps", 1e-6, "control steps, millions"),
        ):
            for run in runs:
                axis.plot(scale * run[x], run["return"], color="tab:blue", alpha=0.4, linewidth=0.8)
            if runs:
                grid, middle = median_curve(runs, x)
                axis.plot(scale * grid, middle, color="tab:blue", linewidth=2.2)
            if env in PUBLISHED:
                axis.axhline(PUBLISHED[env], color="0.3", linestyle="--", linewidth=1)
            axis.set_xlim(left=0)
            axis.set_xlabel(label)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, column].set_title(env)
    for axis in axes[:, 0]:
        axis.set_ylabel("return of training episodes")
    figure.suptitle(f"{args.algorithm}: each seed (thin), median (bold), published SHAC (dashed)", fontsize=10)
    figure.savefig(args.docs / f"{args.algorithm}.png", dpi=110)


def fail(message: str) -> NoReturn:
    print(f"learning.py: {message}", file=sys.stderr)
    sys.exit(2)


def main(args: Args) -> None:
    if unknown := [env for env in args.env if env not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    if not (ROOT / f"{args.algorithm}.py").is_file():
        fail(f"no script {args.algorithm}.py in {ROOT}")
    if not args.collect_only:
        pool = ThreadPoolExecutor(args.jobs)
        try:
            list(pool.map(lambda run: train(args, *run), [(env, seed) for seed in args.seeds for env in args.env]))
        except KeyboardInterrupt:  # the learners got it too, and save
            pool.shutdown(cancel_futures=True)
            fail("interrupted; the same command goes on")
    rows = [row for env in args.env if (row := collect(args, env))]
    if not rows and not list((args.docs / "results").glob(f"{args.algorithm}_*.csv")):
        fail(f"no finished run in {args.runs / args.algorithm}")
    if rows:
        summarise(args, rows)
    draw(args)


if __name__ == "__main__":
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    main(
        dataclasses.replace(
            tyro.cli(Args, args=sys.argv[1:split], description=__doc__), arguments=(*sys.argv[split + 1 :],)
        )
    )

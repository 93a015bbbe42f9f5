"""Learning curves: runs learners on tasks and seeds, evaluates the final policies, and draws and tabulates all of it.

    python benchmarks/learning.py --env ant --seeds 1 2 3              train (finished runs are kept), evaluate, draw
    python benchmarks/learning.py --experiment comparison              the paper's Figures 4 and 7, likewise
    python benchmarks/learning.py --experiment horizon --time-limit 500    stop in time; the same command goes on
    python benchmarks/learning.py --experiment horizon --draw-only     only draw and tabulate what there is
    python benchmarks/learning.py --runs runs/short -- --iterations 50 what follows "--" goes to the learner

Writes docs/results/{algorithm}_{env}.csv (about 100 points of each run), docs/results/{algorithm}_summary.csv,
docs/results/{algorithm}.md and docs/{algorithm}.png; of experiments docs/{experiment}.png and their parts of the page
docs/experiments.md. An interrupted run is resumed from its checkpoint; its curve is drawn as far as it goes.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median, pstdev
from typing import Annotated, Any, Literal, NamedTuple

import matplotlib
import numpy as np
import torch
import tyro
from tables import fill, markdown, read_csv, write_csv

import diffsim
from diffsim import graph
from diffsim.run import fail
from diffsim.tasks import SHAC_TASKS

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
PUBLISHED_PPO = {"hopper": 4742, "ant": 6605, "humanoid": 7293, "humanoid_mtu": 4246}  # in the same place

VARIANTS = {  # of a script: its flags
    "shac_no_critic": ("shac", "--no-critic"),
    "shac_general": ("shac", "--general-hyperparameters"),
    "shac_deterministic": ("shac", "--deterministic-policy"),
    "shac_1024": ("shac", "--num-envs", "1024"),
    "ppo_256": ("ppo_baseline", "--num-envs", "256", "--minibatch-size", "2048", "--entropy-coef", "0"),
    "ppo_4096": ("ppo_baseline", "--num-envs", "4096", "--minibatch-size", "32768", "--entropy-coef", "0"),
    **{f"ppo_e{c}": ("ppo_baseline", "--entropy-coef", c) for c in ("0", "0.002", "0.005", "0.01", "0.02")},
    **{f"shac_h{h}": ("shac", "--horizon", str(h), "--num-envs", str(2048 // h)) for h in (4, 8, 16, 64, 128)},
}


class Experiment(NamedTuple):
    title: str
    algorithms: tuple[str, ...]  # the first is what the others are compared with
    tasks: tuple[str, ...] = SHAC_TASKS


EXPERIMENTS = {
    "comparison": Experiment("Figures 4 and 7: the learners", ("shac", "ppo_baseline", "bptt", "shac_no_critic")),
    "environments": Experiment(
        "SHAC and PPO at several numbers of environments",
        ("shac", "shac_1024", "ppo_256", "ppo_e0", "ppo_4096"),
        ("ant", "humanoid"),
    ),
    "entropy": Experiment(
        "PPO's entropy bonus",
        ("ppo_baseline", "ppo_e0", "ppo_e0.002", "ppo_e0.005", "ppo_e0.01", "ppo_e0.02"),
        ("hopper", "ant", "humanoid"),
    ),
    "horizon": Experiment(
        "Figure 6: short horizon length, 2,048 samples per iteration",
        ("shac", "shac_h4", "shac_h8", "shac_h16", "shac_h64", "shac_h128"),
        ("ant",),
    ),
    "general": Experiment("Figure 8: one setting for all tasks", ("shac", "shac_general")),
    "deterministic": Experiment("Figure 9: deterministic policy", ("shac", "shac_deterministic")),
}
# Returns to which steps and seconds are compared, and the paper's Table 12: forward, backward, critic on a TITAN X.
TARGETS = {"cartpole": -520, "hopper": 3000, "half_cheetah": 6000, "ant": 5000, "humanoid": 5000, "humanoid_mtu": 4246}
TABLE_12 = {"cartpole": (0.15, 0.23, 0.34), "ant": (0.25, 0.37, 0.32), "humanoid": (0.91, 1.97, 0.32)}


@dataclass
class Args:
    algorithm: str = "shac"
    """learner: a script in the repository's root, without .py, or a variant of one, e.g. shac_no_critic"""
    experiment: (
        Literal["comparison", "environments", "entropy", "horizon", "general", "deterministic", "time"] | None
    ) = None
    """several learners at once, drawn together: Figures 4 and 7 of the SHAC paper, two more of the kind, its Figures
    6, 8 and 9, or its Table 12"""
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = SHAC_TASKS
    """tasks"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of each task"""
    device: str | None = None
    """torch device of the learners; None: the GPU if there is one"""
    jobs: int = 1
    """runs at a time; they share the device, which slows each of them down"""
    time_limit: float | None = None
    """seconds after which the runs in progress are stopped, to be resumed by the next call; None: no limit"""
    arguments: tyro.conf.Suppress[tuple[str, ...]] = ()
    finer: int = 4
    """the final policies are evaluated a second time, explicitly, with this many times the substeps"""
    runs: Path = ROOT / "runs" / "learning"
    """directory of the runs: {runs}/{algorithm}/{env}__{seed}"""
    docs: Path = ROOT / "docs"
    """directory of what is written"""
    draw_only: Annotated[bool, tyro.conf.arg(aliases=["--collect-only"])] = False
    """train and evaluate nothing: csv files, pictures and tables of the runs at hand"""
    stop_at: tyro.conf.Suppress[float] = float("inf")


# Runs -----------------------------------------------------------------------------------------------------------------


def learner(args: Args, *arguments: object) -> list[str]:
    script, *_ = VARIANTS.get(args.algorithm, (args.algorithm,))
    command = [sys.executable, str(ROOT / f"{script}.py"), *map(str, arguments)]
    if args.device:
        command += ["--device", args.device]
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


def call(args: Args, folder: Path, *arguments: object) -> str | None:
    """What a learner prints, which output.txt keeps; None if it failed or if the time was up, which lets it save."""
    with (folder / "output.txt").open("a+") as output:
        before = output.seek(0, os.SEEK_END)
        process = subprocess.Popen(learner(args, *arguments), stdout=output, stderr=output)
        try:
            process.wait(None if args.stop_at == float("inf") else max(0.0, args.stop_at - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM)
            process.wait()
        output.seek(before)
        return output.read() if process.returncode == 0 else None


def train(args: Args, env: str, seed: int) -> None:
    """One run from where it stands to its evaluation; `evaluation.json` marks it as finished."""
    folder, name = run_dir(args, env, seed), f"{args.algorithm}, {env}, seed {seed}"
    checkpoint = folder / "checkpoint.pt"
    if (folder / "evaluation.json").exists():
        print(f"{name}: finished before", flush=True)
        return
    if time.monotonic() >= args.stop_at:
        return
    folder.mkdir(parents=True, exist_ok=True)
    _, *flags = VARIANTS.get(args.algorithm, (args.algorithm,))
    start = ["--env", env, "--seed", seed, "--run-dir", folder, *flags]
    if checkpoint.exists():
        start = ["--resume", checkpoint]
    if not trained(folder) and call(args, folder, *start, "--quiet", *args.arguments) is None:
        print(f"{name}: stopped or failed, see {folder / 'output.txt'}", flush=True)
        return
    substeps = json.loads((folder / "args.json").read_text())["substeps"] or diffsim.TASKS[env].substeps
    evaluation = {"substeps": substeps, "finer_substeps": args.finer * substeps}
    finer = ("--substeps", args.finer * substeps, "--integrator", "semi_implicit")
    for key, setting in (("own", ()), ("finer", finer)):
        if (text := call(args, folder, "--evaluate", checkpoint, *setting)) is None:
            print(f"{name}: not evaluated, see {folder / 'output.txt'}", flush=True)
            return
        found = re.search(r"return median (-?[\d.]+)", text)
        if not found:
            raise RuntimeError(f"no 'return median <number>' in {folder / 'output.txt'}")
        evaluation[key] = float(found[1])
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    print(f"{name}: {evaluation}", flush=True)


# Collecting -----------------------------------------------------------------------------------------------------------

Curve = dict[str, np.ndarray]


def published_by(algorithm: str) -> tuple[str, dict[str, int]]:
    """Whose published returns a learner is held against, and they."""
    return ("PPO", PUBLISHED_PPO) if algorithm == "ppo_baseline" else ("SHAC", PUBLISHED)


def number(text: str) -> float:
    return float(text) if text else float("nan")


def subsample(rows: list[dict[str, str]], target: float) -> list[dict[str, str]]:
    """About POINTS rows, evenly spread; every row that has an evaluation, the best one, and the first at the target."""
    keep = set(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int))
    returns = [number(row["return"]) for row in rows]
    keep |= {k for k, row in enumerate(rows) if row["eval_return"]}
    keep |= set([k for k, value in enumerate(returns) if value >= target][:1])
    keep |= {k for k, value in enumerate(returns) if value == np.nanmax(returns)}
    return [rows[k] for k in sorted(keep)]


def collect(args: Args, env: str) -> dict[str, Any] | None:
    """Writes the task's csv, of all its runs, and returns its row of the summary, of those that have finished."""
    points, seeds, final, finer, seconds, substeps = [], [], [], [], [], ""
    passed: dict[float, list[float]] = {t: [] for t in THRESHOLDS.get(env, ())}
    for folder in sorted((args.runs / args.algorithm).glob(f"{env}__*"), key=lambda p: int(p.name.split("__")[1])):
        seed, path = folder.name.split("__")[1], folder / "progress.csv"
        progress = read_csv(path)
        if not any(row["return"] for row in progress):
            continue
        points += [
            {"seed": seed} | {c: short(row[c]) for c in COLUMNS}
            for row in subsample(progress, TARGETS.get(env, float("inf")))
        ]
        if not (folder / "evaluation.json").exists():
            continue
        evaluation = json.loads((folder / "evaluation.json").read_text())
        seeds.append(seed)
        final.append(evaluation["own"])
        finer.append(evaluation["finer"])
        seconds.append(float(progress[-1]["seconds"]))
        substeps = f"{evaluation['substeps']} / {evaluation['finer_substeps']}"
        for threshold, times in passed.items():
            at = (float(r["seconds"]) for r in progress if r["return"] and float(r["return"]) >= threshold)
            times.append(next(at, float("inf")))
    if points:
        write_csv(args.docs / "results" / f"{args.algorithm}_{env}.csv", points)
    if not seeds:
        return None
    kept = median(finer) / median(final)
    if median(final) < 0:
        kept = 1 / kept
    label, published = published_by(args.algorithm)
    return {
        "task": env,
        "seeds": " ".join(seeds),
        "return": f"{median(final):.0f}",
        "each seed": " ".join(f"{r:.0f}" for r in final),
        f"published {label}": published.get(env, ""),
        "training": f"{median(seconds):.0f} s",
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
    merged = {row["task"]: row for row in read_csv(path)}
    merged |= {row["task"]: row for row in rows}
    merged = [merged[env] for env in diffsim.TASKS if env in merged]
    write_csv(path, merged)
    text = markdown(merged)
    (args.docs / "results" / f"{args.algorithm}.md").write_text(text)
    page = args.docs / f"{args.algorithm.removesuffix('_baseline')}.md"
    if page.is_file() and "<!-- results -->" in page.read_text():
        fill(page, "results", text)
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
    label, published = published_by(args.algorithm)
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
            if env in published:
                axis.axhline(published[env], color="0.3", linestyle="--", linewidth=1)
            axis.set_xlim(left=0)
            axis.set_xlabel(label)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, column].set_title(env)
    for axis in axes[:, 0]:
        axis.set_ylabel("return of training episodes")
    figure.suptitle(f"{args.algorithm}: each seed (thin), median (bold), published {label} (dashed)", fontsize=10)
    figure.savefig(args.docs / f"{args.algorithm}.png", dpi=110)


# Experiments ----------------------------------------------------------------------------------------------------------


def results(args: Args, algorithm: str, env: str) -> list[Curve]:
    path = args.docs / "results" / f"{algorithm}_{env}.csv"
    return curves(path) if path.is_file() else []


def compared(args: Args, experiment: Experiment) -> list[str]:
    """The tasks on which there are two learners to compare."""
    return [env for env in experiment.tasks if sum(bool(results(args, a, env)) for a in experiment.algorithms) > 1]


def draw_experiment(args: Args, name: str, suffix: str = "", full: bool = False) -> None:
    """Mean and standard deviation over seeds; on linear axes up to where the first learner ends, or all on log axes."""
    experiment = EXPERIMENTS[name]
    tasks = compared(args, experiment)
    figure, axes = plt.subplots(2, len(tasks), figsize=(3.4 * len(tasks), 5.6), squeeze=False, layout="constrained")
    for column, env in enumerate(tasks):
        for axis, x, label in zip(
            axes[:, column], ("control_steps", "seconds"), ("control steps", "wall s"), strict=True
        ):
            limit = max((run[x][-1] for run in results(args, experiment.algorithms[0], env)), default=float("inf"))
            for number_, algorithm in enumerate(experiment.algorithms):
                if not (runs := results(args, algorithm, env)):
                    continue
                grid = np.geomspace(max(r[x][0] for r in runs), min(r[x][-1] for r in runs), 400)
                values = np.array([np.interp(grid, r[x], r["return"]) for r in runs])
                middle, spread = values.mean(0), values.std(0)
                axis.plot(grid, middle, color=f"C{number_}", label=algorithm)
                axis.fill_between(grid, middle - spread, middle + spread, color=f"C{number_}", alpha=0.2, linewidth=0)
            if full:
                axis.set_xscale("log")
            elif limit < float("inf"):
                axis.set_xlim(0, limit)
            axis.set_xlabel(label)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, column].set_title(env)
    lines = {line.get_label(): line for axis in axes[0] for line in axis.lines}
    axes[0, 0].legend(lines.values(), lines.keys(), fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("return of training episodes")
    figure.savefig(args.docs / f"{name}{suffix}.png", dpi=110)
    plt.close(figure)


def draw_horizon(args: Args) -> None:
    """Figure 6: best return and training time against the horizon."""
    points = []
    for algorithm in EXPERIMENTS["horizon"].algorithms:
        if runs := results(args, algorithm, "ant"):
            best = [np.max(run["return"]) for run in runs]
            seconds = mean(run["seconds"][-1] for run in runs)
            points.append((int(algorithm.partition("_h")[2] or 32), mean(best), pstdev(best), seconds))
    h, best, spread, seconds = zip(*sorted(points), strict=True)
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
    axes[0].errorbar(h, best, spread, marker="o", capsize=3)
    axes[1].plot(h, seconds, marker="o")
    for axis, label in zip(axes, ("best return", "training, wall s"), strict=True):
        axis.set_xscale("log", base=2)
        axis.set_xlabel("horizon h")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    figure.savefig(args.docs / "horizon.png", dpi=110)
    plt.close(figure)


def passing(runs: list[Curve], target: float) -> tuple[float, float]:
    """Median over seeds of the control steps and the wall seconds at which the return first passes the target."""
    first = [np.flatnonzero(run["return"] >= target) for run in runs]
    return tuple(
        median(run[x][k[0]] if len(k) else float("inf") for run, k in zip(runs, first, strict=True))
        for x in ("control_steps", "seconds")
    )


def table(args: Args, experiment: Experiment) -> list[dict[str, Any]]:
    rows = []
    for env in compared(args, experiment):
        target, reference = TARGETS[env], None
        for algorithm in experiment.algorithms:
            if not (runs := results(args, algorithm, env)):
                continue
            best = [np.max(run["return"]) for run in runs]
            evaluations = [run["eval_return"][~np.isnan(run["eval_return"])] for run in runs]
            final = [values[-1] for values in evaluations if len(values)]
            steps, seconds = passing(runs, target)
            if algorithm == experiment.algorithms[0]:
                reference = steps, seconds
            ratio = ""
            if reference and max(reference) < float("inf"):
                ratio = " / ".join(f"{v / r:.3g}" for v, r in zip((steps, seconds), reference, strict=True))
                ratio = "never" if steps == float("inf") else ratio
            published = published_by(algorithm)[1] if algorithm in ("shac", "ppo_baseline") else {}
            rows.append(
                {
                    "task": env,
                    "learner": algorithm,
                    "seeds": len(runs),
                    "best return of training": f"{mean(best):.0f} ± {pstdev(best):.0f}",
                    "published": published.get(env, ""),
                    "final policy, deterministic": f"{median(final):.0f}" if final else "",
                    "control steps": f"{median(run['control_steps'][-1] for run in runs):.3g}",
                    "training, s": f"{median(run['seconds'][-1] for run in runs):.0f}",
                    "control steps / s": f"{median(run['control_steps'][-1] / run['seconds'][-1] for run in runs):.3g}",
                    "return passed": target,
                    "after control steps": f"{steps:.3g}" if steps < float("inf") else "never",
                    "after s": f"{seconds:.0f}" if seconds < float("inf") else "never",
                    f"times {experiment.algorithms[0]}'s steps / s": ratio,
                }
            )
    return rows


def time_breakdown(args: Args, env_name: str) -> dict[str, Any]:
    """Table 12: the parts of one iteration of SHAC, each captured and timed alone."""
    sys.path.insert(0, str(ROOT))
    shac = importlib.import_module("shac")
    settings, _ = shac.parse(["--env", env_name, *(["--device", args.device] if args.device else []), *args.arguments])
    horizon, num_envs, gamma = settings.horizon, settings.num_envs, settings.gamma
    env = shac.make_env(settings, num_envs, horizon)
    actor, normalise = shac.build(settings, env)
    critic = shac.mlp(normalise.mean.numel(), settings.critic_hidden, 1, orthogonal=True).to(env.device)
    actor_optimizer, critic_optimizer = (shac.ClippedAdam(module, settings) for module in (actor, critic))
    obs = torch.randn(horizon * num_envs // settings.critic_minibatches, normalise.mean.numel(), device=env.device)

    def forward() -> torch.Tensor:
        window = shac.collect(env, actor, normalise, actor.sample_noise(horizon, num_envs))
        return shac.actor_loss(window.reward, shac.next_values(critic, normalise, window), window.done, gamma)

    def update_critic() -> None:
        for _ in range(settings.critic_iterations * settings.critic_minibatches):
            critic_optimizer.step(critic(obs).square().mean())

    parts = [(lambda: forward().detach(), env), (lambda: actor_optimizer.step(forward()), env), (update_critic, None)]
    first, both, fitting = (timed(graph.capture(part, env.device, of), env.device) for part, of in parts)
    place = torch.cuda.get_device_name(env.device) if env.device.type == "cuda" else "cpu"
    ours = {"forward": first, "backward": both - first, "critic": fitting}
    published = dict(zip(ours, TABLE_12.get(env_name, ("",) * 3), strict=True))
    row = {"task": env_name, "environments": num_envs, "device": place}
    row |= {f"{part}, ms": f"{1000 * seconds:.3g}" for part, seconds in ours.items()}
    return row | {f"published {part}, s (TITAN X)": published[part] for part in ours}


def timed(function: Callable[[], Any], device: torch.device, warmup: int = 4, calls: int = 20) -> float:
    """Seconds of one call, once warm."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    for k in range(warmup + calls):
        if k == warmup:
            wait()
            begin = time.perf_counter()
        function()
    wait()
    return (time.perf_counter() - begin) / calls


def write_page(args: Args) -> None:
    """Pictures and tables of the csv files that there are: of this experiment, and of those that the page shows."""
    page = args.docs / "experiments.md"
    shown = page.read_text() if page.is_file() else ""
    for name, experiment in EXPERIMENTS.items():
        if name != args.experiment and f"<!-- {name} -->" not in shown:
            continue
        if not (rows := table(args, experiment)):
            continue
        text = f"{markdown(rows)}\n![{experiment.title}]({name}.png)\n"
        if name == "horizon":
            draw_horizon(args)
        else:
            draw_experiment(args, name)
        if name == "comparison":
            draw_experiment(args, name, "_full", full=True)
            text += f"\n![{experiment.title}, to their ends]({name}_full.png)\n"
        fill(page, name, text)
        print(text)
    if (args.docs / "results" / "time.csv").is_file():
        fill(page, "time", markdown(read_csv(args.docs / "results" / "time.csv")))


def main(args: Args) -> None:
    if unknown := [env for env in args.env if env not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    experiment = EXPERIMENTS.get(args.experiment)
    algorithms = experiment.algorithms if experiment else (args.algorithm,)
    if not experiment and not (ROOT / f"{VARIANTS.get(args.algorithm, (args.algorithm,))[0]}.py").is_file():
        fail(f"no script {args.algorithm}.py in {ROOT}")
    if args.experiment == "time":
        path = args.docs / "results" / "time.csv"
        merged = {row["task"]: row for row in read_csv(path)}
        merged |= {env: time_breakdown(args, env) for env in args.env}
        write_csv(path, [merged[env] for env in diffsim.TASKS if env in merged])
        write_page(args)
        return
    tasks = [env for env in args.env if not experiment or env in experiment.tasks]
    if args.time_limit is not None:
        args = dataclasses.replace(args, stop_at=time.monotonic() + args.time_limit)
    parts = [dataclasses.replace(args, algorithm=algorithm) for algorithm in algorithms]
    if not args.draw_only:
        pool = ThreadPoolExecutor(args.jobs)
        try:
            runs = [(part, env, seed) for seed in args.seeds for env in tasks for part in parts]
            list(pool.map(lambda run: train(*run), runs))
        except KeyboardInterrupt:  # the learners got it too, and save
            pool.shutdown(cancel_futures=True)
            fail("interrupted; the same command goes on")
    for part in parts:
        if rows := [row for env in tasks if (row := collect(part, env))]:
            summarise(part, rows)
        elif not list((args.docs / "results").glob(f"{part.algorithm}_*.csv")):
            print(f"no episode finished yet in {args.runs / part.algorithm}", file=sys.stderr)
            if not experiment:
                sys.exit(0 if time.monotonic() >= part.stop_at else 2)
    if experiment:
        write_page(args)
    else:
        draw(args)


if __name__ == "__main__":
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    main(
        dataclasses.replace(
            tyro.cli(Args, args=sys.argv[1:split], description=__doc__), arguments=(*sys.argv[split + 1 :],)
        )
    )

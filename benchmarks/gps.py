"""Guided policy search: runs its variants on tasks and seeds, and draws and tabulates what came of them.

    python benchmarks/gps.py                                             the runs of docs/gps.md; finished ones are kept
    python benchmarks/gps.py --env cartpole --seeds 1 --variants full nonguided    a part of them
    python benchmarks/gps.py --draw-only                                 only draw and tabulate what there is
    python benchmarks/gps.py --record hop.npz --actor runs/<run>/checkpoint.pt     record a policy of shac.py
    python benchmarks/gps.py --runs runs/short -- --iterations 5         what follows "--" goes to gps.py

Writes docs/results/gps_runs.csv (every iteration of every run), gps_generalisation.csv (the policy, the DDP controller
and that of the nearest state, from perturbed starts and under pushes), gps_paths.csv (where the root went),
gps_time.csv (one iteration of iLQR) and gps.md (tables), and the pictures docs/gps_variants.png, gps_paths.png and
gps_generalisation.png: Figures 2, 1 and 3 of the paper. An interrupted run is resumed from its checkpoint.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import matplotlib
import numpy as np
import torch
import tyro
from tables import markdown, read_csv, write_csv
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # this file is called gps, too: the learner's comes first
import gps  # noqa: E402
import shac  # noqa: E402
from diffsim.run import fail, load_checkpoint  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

HALF = "--iterations 30 --horizon 160 --ilqr-iterations 100"
# What docs/gps.md shows, per task: seeds, variants, flags
SUITE: dict[str, tuple[tuple[int, ...], tuple[str, ...], str]] = {
    "cartpole": ((1, 2, 3, 4, 5), ("full", "unregularized"), "--iterations 30"),
    "hopper": ((1,), ("full", "policy-gradient", "single-example"), HALF),
    "swimmer": ((1,), ("full",), HALF),
    "walker": ((1,), ("full",), "--iterations 30 --horizon 100 --ilqr-iterations 100"),
    "ant": ((1,), ("full",), "--iterations 30 --horizon 100 --ilqr-iterations 100"),
}
RUN = ("env", "variant", "seed")
KEPT = ("iteration", "control_steps", "seconds", "return", "objective", "objective_std", "accepted", "regularizer")
KEPT += ("plan", "guides", "guides_std", "fit", "eval_objective", "eval_objective_std", "eval_without_noise")
KEPT += ("eval_return", "eval_speed", "ess", "guide_share", "model_steps")
TARGETS = {"cartpole": (-1000, -830, -520), "hopper": (250, 400)}  # returns to which learners are compared
STARTS, PUSHES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), (0.5, 1.0, 2.0)
COLOURS = dict(zip(gps.Variant.__args__, plt.get_cmap("tab10").colors, strict=False))
CONTROLLERS = {"policy": "C0", "ddp": "C3", "tbdp": "C1"}


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = tuple(SUITE)
    """tasks"""
    seeds: tuple[int, ...] | None = None
    """seeds; None: the suite's"""
    variants: tuple[gps.Variant, ...] | None = None
    """variants; None: the suite's"""
    jobs: int = 1
    """runs at a time, each with one thread"""
    arguments: tyro.conf.Suppress[tuple[str, ...]] = ()
    count: int = 20
    """perturbed starts and pushes of each size"""
    runs: Path = ROOT / "runs" / "gps"
    """directory of the runs: {runs}/{env}__{variant}__{seed}"""
    docs: Path = ROOT / "docs"
    """directory of what is written"""
    draw_only: bool = False
    """train nothing: collect, draw and tabulate the runs there are"""
    record: Path | None = None
    """write a demonstration, the trajectory of --actor's deterministic policy, here; nothing else is done"""
    actor: Path | None = None
    """checkpoint of shac.py that --record follows"""
    steps: int = 500
    """control steps of a recording"""


# Demonstrations -------------------------------------------------------------------------------------------------------


def record(path: Path, actor_path: Path | None, steps: int) -> None:
    """The trajectory of shac.py's policy from the task's unperturbed start: qpos, qvel and action."""
    if actor_path is None:
        fail("--record needs --actor, a checkpoint of shac.py")
    checkpoint = load_checkpoint(actor_path, shac.FORMAT)
    args = shac.Args(**checkpoint["args"])
    options = dict(substeps=args.substeps, integrator=args.integrator, stochastic_init=False, early_termination=False)
    env = gps.diffsim.make(args.env, 1, horizon=1, **options)
    args.device = "cpu"
    env.episode_length = steps + 1  # no reset within the recording
    actor, normalise = shac.build(args, env)
    actor.load_state_dict(checkpoint["actor"])
    normalise.load_state_dict(checkpoint["normalise"])
    obs, _ = env.reset()
    states, actions = [(env.qpos, env.qvel)], []
    with torch.no_grad():
        for _ in range(steps):
            actions.append(actor(normalise(obs)))
            obs = env.step(actions[-1])[0]
            states.append((env.qpos, env.qvel))
    qpos, qvel = (torch.cat(parts).numpy() for parts in zip(*states, strict=True))
    with path.open("wb") as file:
        np.savez(file, qpos=qpos, qvel=qvel, action=torch.cat(actions).numpy())
    print(f"{args.env}, {steps} control steps: {path}")


# Runs -----------------------------------------------------------------------------------------------------------------


def train(directory: Path, env: str, variant: str, seed: int, flags: list[str]) -> str:
    """Trains, or resumes, or finds that it is done; returns what there is to say."""
    checkpoint, new = directory / "checkpoint.pt", ["--env", env, "--variant", variant, "--seed", str(seed)]
    if checkpoint.exists():
        state = load_checkpoint(checkpoint, gps.FORMAT)
        if state["iteration"] >= state["args"]["iterations"]:
            return f"{directory.name}: done before"
        new = ["--resume", str(checkpoint)]
    command = [sys.executable, str(ROOT / "gps.py"), *new, "--run-dir", str(directory), "--threads", "1", *flags]
    with (directory.parent / f"{directory.name}.log").open("a") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT).returncode
    return f"{directory.name}: {'done' if code == 0 else f'exit code {code}, see {log.name}'}"


def time_ilqr(env: str = "hopper", horizon: int = 500, repeats: int = 5) -> list[dict[str, Any]]:
    """Seconds of an iLQR iteration of one trajectory: Jacobians and quadratics, backward pass, line search."""
    rows = []
    for threads in (1, None):
        flags = ["--threads", "1"] if threads else []
        system = gps.make_system(gps.parse(["--env", env, "--horizon", str(horizon), "--device", "cpu", *flags])[0])
        rng = torch.Generator().manual_seed(1)
        u = 0.1 * torch.randn(1, horizon, system.nu, generator=rng, dtype=gps.REAL)
        x, _, _ = system.rollout(system.start(), horizon, lambda t, _, u=u: u[:, t])
        cost = gps.Cost(system)
        gps.ilqr(cost, x, u, 1)  # compiles
        begin = time.perf_counter(), time.process_time()  # the second is not disturbed by other work on the machine
        gps.ilqr(cost, x, u, repeats)
        wall, cpu = (
            (now - then) / repeats for now, then in zip((time.perf_counter(), time.process_time()), begin, strict=True)
        )
        seconds = {"seconds": round(wall, 3), "seconds of CPU": round(cpu, 3)}
        rows.append(dict(env=env, horizon=horizon, threads=threads or "all cores") | seconds)
    return rows


# Generalisation -------------------------------------------------------------------------------------------------------


def load_search(checkpoint: Path) -> gps.Search:
    args, state = gps.parse(["--evaluate", str(checkpoint), "--device", "cpu", "--threads", "1"])
    search = gps.Search(args, gps.make_system(args))
    search.load_state_dict(state["search"])
    return search


def controllers(search: gps.Search) -> dict[str, Callable[[int, Tensor], Tensor]]:
    """The policy's mean; the DDP controller; and the DDP controller of the nearest state (TBDP), in scaled tangents."""
    system, policy, guide = search.system, search.policy, search.guides[0]
    path = guide.x[:-1]
    scale = system.difference(path, path[:1]).std(0).clamp(min=1e-3)
    if search.args.env != "cartpole":
        scale[0] = math.inf  # wherever it is along x

    def nearest(_: int, x: Tensor) -> Tensor:
        distance = (system.difference(x.unsqueeze(1), path.unsqueeze(0)) / scale).square().sum(-1)
        t = distance.argmin(1)
        return guide.u[t] + (guide.K[t] @ system.difference(x, path[t]).unsqueeze(-1)).squeeze(-1)

    return {
        "policy": lambda _, x: policy.mean(search.theta, system.observe(x)),
        "ddp": lambda t, x: guide.mean(system, t, x),
        "tbdp": nearest,
    }


def generalisation(search: gps.Search, count: int) -> list[dict[str, Any]]:
    """Each controller from the same perturbed starts and under the same pushes.

    A start differs by a normal vector of `size` times the standard deviation of each coordinate over the plan; a push
    changes the root's velocity along x by `size` m/s in either direction, a quarter of the time in. A trajectory is
    kept if its return is within a quarter of the guides' mean.
    """
    system, horizon = search.system, search.args.horizon
    rng = torch.Generator().manual_seed(gps.EVALUATION_SEED)
    path = search.guides[0].x[:-1]
    spread = system.difference(path, path[:1]).std(0)
    draws = torch.randn(count, system.nd, generator=rng, dtype=gps.REAL)
    rows = []
    for kind, size in [("start", size) for size in STARTS] + [("push", size) for size in PUSHES]:
        start, push = search.start.expand(count, -1), None
        if kind == "start":
            start = system.retract(start, size * spread * draws)
        else:
            kick = torch.zeros_like(draws)
            kick[:, system.nv] = size * draws[:, 0].sign()
            push = horizon // 4, kick
        for name, act in controllers(search).items():
            returns = search.measure(*system.rollout(start, horizon, act, push)).returns
            kept = returns >= search.guide_return[0] - 0.25 * abs(search.guide_return[0])
            numbers = dict(mean=returns.mean().item(), std=returns.std(correction=0).item())
            rows.append(dict(kind=kind, size=size, controller=name, **numbers, kept=kept.double().mean().item()))
    return rows


def paths(search: gps.Search, count: int = 10) -> list[dict[str, Any]]:
    """Where plan, guiding samples and the noisy policy's trajectories go: the first two coordinates."""
    guides = search.guides[0].sample(search.system, search.noise(count))[0]
    policy = search.follow(search.theta, search.noise(count)).x
    rows = []
    for name, x in (("plan", search.guides[0].x[None]), ("guides", guides), ("policy", policy)):
        for i, trajectory in enumerate(x[..., :2].tolist()):
            rows += [dict(what=name, number=i, step=t, x=a, y=b) for t, (a, b) in enumerate(trajectory)]
    return rows


# Tables and pictures --------------------------------------------------------------------------------------------------


def number(text: str) -> float:
    return float(text) if text else math.nan


def grouped(rows: Iterable[dict[str, str]], *keys: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def collect(args: Args) -> None:
    """From the runs to docs/results; rows of runs that are not here stay as they are there."""
    tables: dict[str, list[dict[str, Any]]] = {"runs": [], "generalisation": [], "paths": []}
    for directory in sorted(path for path in args.runs.glob("*__*__*") if (path / "progress.csv").is_file()):
        run = dict(zip(RUN, directory.name.split("__"), strict=True))
        horizon = json.loads((directory / "args.json").read_text())["horizon"]
        for row in read_csv(directory / "progress.csv"):
            kept = {key: f"{float(row[key]):.6g}" if row[key] else "" for key in KEPT}
            tables["runs"].append(run | dict(horizon=horizon) | kept)
        if run["variant"] == "full" and (directory / "checkpoint.pt").is_file():
            if not (directory / "generalisation.csv").is_file():
                search = load_search(directory / "checkpoint.pt")
                write_csv(directory / "generalisation.csv", generalisation(search, args.count))
                write_csv(directory / "paths.csv", paths(search))
            for name in ("generalisation", "paths"):
                tables[name] += [run | row for row in read_csv(directory / f"{name}.csv")]
    for name, rows in tables.items():
        path = args.docs / "results" / f"gps_{name}.csv"
        here = {tuple(row[key] for key in RUN) for row in rows}
        if name == "paths":  # one seed a task is drawn
            first: dict[str, str] = {}
            rows = [row for row in rows if row["seed"] == first.setdefault(row["env"], row["seed"])]
            rows = [row | {key: f"{float(row[key]):.4g}" for key in "xy"} for row in rows if int(row["step"]) % 4 == 0]
        rows = [row for row in read_csv(path) if tuple(row[key] for key in RUN) not in here] + rows
        write_csv(path, sorted(rows, key=lambda row: tuple(row[key] for key in RUN)))


def tabulate(docs: Path) -> str:
    """docs/results/gps.md"""
    runs, table = grouped(read_csv(docs / "results" / "gps_runs.csv"), *RUN), []
    for (env, variant, seed), rows in runs.items():
        first, last, evaluated = rows[0], rows[-1], [row for row in rows if row["eval_objective"]]
        half = [number(row["objective"]) for row in rows[len(rows) // 2 :]]
        final = evaluated[-1] if evaluated else dict.fromkeys(KEPT, "")
        mean, std, plan = (
            number(text) for text in (final["eval_objective"], final["eval_objective_std"], first["plan"])
        )
        table.append(
            {
                "task": env,
                "variant": variant,
                "seed": seed,
                "T": first["horizon"],
                "plan": f"{plan:.1f}",
                "guides": f"{number(first['guides']):.1f} ± {number(first['guides_std']):.1f}",
                "fit": f"{number(first['fit']):.2f}",
                "pretrained": f"{number(first['objective']):.1f}",
                "iterations": last["iteration"],
                "accepted": sum(row["accepted"] in ("1", "1.0") for row in rows),
                "proposals, last half": f"{sum(half) / len(half):.1f}",
                "final policy": f"{mean:.1f} ± {std:.1f}",
                "reaches plan": "yes" if mean >= plan else "no",
                "own return": final["eval_return"],
                "speed": final["eval_speed"],
                "control steps": f"{float(last['control_steps']):,.0f}",
                "of planning": f"{float(last['model_steps'] or 'nan'):,.0f}",
                "seconds": f"{float(last['seconds']):.0f}",
            }
        )
    text = "## Runs\n\n" + markdown(table) + "\n## Generalisation\n\n"
    groups, table = grouped(read_csv(docs / "results" / "gps_generalisation.csv"), "env", "kind", "size"), []
    for (env, kind, size), rows in groups.items():
        cells = {}
        for name in CONTROLLERS:
            own = [row for row in rows if row["controller"] == name]
            kept, mean = (sum(float(row[key]) for row in own) / len(own) for key in ("kept", "mean"))
            cells[name] = f"{kept:.0%} ({mean:.0f})"
        table.append({"task": env, "perturbed": kind, "size": size, "seeds": len(rows) // len(CONTROLLERS)} | cells)
    text += markdown(table) + "\n## Control steps to the same return\n\n" + markdown(compare(docs))
    text += "\n## Time of an iLQR iteration\n\n"
    return text + markdown(read_csv(docs / "results" / "gps_time.csv"))  # type: ignore[arg-type]


def compare(docs: Path) -> list[dict[str, Any]]:
    """Control steps of samples until the mean return of training first passes a target: of the seeds that do, median.

    Returns are the task's own over our horizon T; an episode of another length counts as T times its mean step.
    """
    runs, table = grouped(read_csv(docs / "results" / "gps_runs.csv"), *RUN), []
    for env, targets in TARGETS.items():
        learners = {"gps": [rows for (task, variant, _), rows in runs.items() if (task, variant) == (env, "full")]}
        for name in ("shac", "ppo_baseline"):
            learners[name] = list(grouped(read_csv(docs / "results" / f"{name}_{env}.csv"), "seed").values())
        if not learners["gps"]:
            continue
        T = float(learners["gps"][0][0]["horizon"])
        planning = median(float(rows[0]["model_steps"]) for rows in learners["gps"])
        for target in targets:
            cells = {}
            for name, seeds in learners.items():
                steps = [first_pass(rows, target, T) for rows in seeds]
                reached = [count for count in steps if count < math.inf]
                cells[name] = f"{median(reached):,.0f}" if reached else "never"
                cells[name] += f" ({len(reached)} of {len(seeds)})"
            table.append(
                {"task": env, "T": f"{T:.0f}", "return": target} | cells | {"gps, of planning": f"{planning:,.0f}"}
            )
    return table


def first_pass(rows: list[dict[str, str]], target: float, T: float) -> float:
    passed = (row for row in rows if number(row["return"]) * T / float(row.get("length") or T) >= target)
    return next((float(row["control_steps"]) for row in passed), math.inf)


def draw(docs: Path) -> None:
    runs = grouped(read_csv(docs / "results" / "gps_runs.csv"), *RUN)
    envs = sorted({env for env, _, _ in runs})
    if not envs:
        return
    figure, axes = plt.subplots(1, len(envs), figsize=(4.2 * len(envs), 3.4), squeeze=False)
    for ax, env in zip(axes[0], envs, strict=True):
        low, high = [], []
        for (_, variant, _), rows in ((key, rows) for key, rows in runs.items() if key[0] == env):
            own = [other for (e, v, _), other in runs.items() if (e, v) == (env, variant)]
            first = own[0] is rows
            values = [number(row["objective"]) for row in rows]
            ax.plot([int(row["iteration"]) for row in rows], values, color=COLOURS[variant], lw=0.6, alpha=0.5)
            plan, guides, std = (number(rows[0][key]) for key in ("plan", "guides", "guides_std"))
            low, high = [*low, plan, guides, *np.percentile(values, [20])], [*high, plan, *values]
            if first:
                ax.axhspan(guides - 2 * std, guides + 2 * std, color="0.6", alpha=0.4, lw=0)
                length = min(map(len, own))
                middle = np.median([[number(row["objective"]) for row in other[:length]] for other in own], 0)
                ax.plot(range(length), middle, color=COLOURS[variant], lw=2, label=variant)
        bottom, top = min(low), max(high)
        ax.set_ylim(bottom - 0.3 * (top - bottom), top + 0.1 * (top - bottom))
        ax.set(title=env, xlabel="iteration", ylabel="mean return of the proposed policy")
        ax.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(docs / "gps_variants.png", dpi=110)

    tracks = grouped(read_csv(docs / "results" / "gps_paths.csv"), "env")
    figure, axes = plt.subplots(1, max(1, len(tracks)), figsize=(4.2 * max(1, len(tracks)), 3), squeeze=False)
    for ax, ((env,), rows) in zip(axes[0], tracks.items(), strict=False):
        for (what, _), track in grouped(rows, "what", "number").items():
            style = {"plan": ("k", 2.0, 3), "guides": ("0.6", 0.8, 1), "policy": ("C0", 0.8, 2)}[what]
            label = what if track[0]["number"] == "0" else None
            xy = [[float(row[key]) for row in track] for key in "xy"]
            ax.plot(*xy, color=style[0], lw=style[1], zorder=style[2], label=label)
        names = {"cartpole": ("x (m)", "angle (rad)"), "swimmer": ("x (m)", "y (m)"), "ant": ("x (m)", "y (m)")}
        ax.set(title=env, **dict(zip(("xlabel", "ylabel"), names.get(env, ("x (m)", "height (m)")), strict=True)))
        ax.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(docs / "gps_paths.png", dpi=110)

    groups = grouped(read_csv(docs / "results" / "gps_generalisation.csv"), "env", "kind")
    kinds = sorted({env for env, _ in groups})
    figure, axes = plt.subplots(2, max(1, len(kinds)), figsize=(3.6 * max(1, len(kinds)), 5), squeeze=False)
    for column, env in zip(axes.T, kinds, strict=False):
        for ax, kind in zip(column, ("start", "push"), strict=True):
            for name, colour in CONTROLLERS.items():
                own = [row for row in groups[env, kind] if row["controller"] == name]
                kept = {float(k[0]): np.mean([float(r["kept"]) for r in g]) for k, g in grouped(own, "size").items()}
                ax.plot(list(kept), [100 * value for value in kept.values()], "o-", color=colour, label=name)
            unit = "perturbation of the start" if kind == "start" else "push (m/s)"
            ax.set(title=env, xlabel=unit, ylabel="kept (%)", ylim=(-5, 105))
        column[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(docs / "gps_generalisation.png", dpi=110)


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    own, _, rest = (argv[: argv.index("--")], "--", argv[argv.index("--") + 1 :]) if "--" in argv else (argv, "", [])
    args = tyro.cli(Args, args=own, description=__doc__)
    torch.set_num_threads(1)
    if args.record:
        record(args.record, args.actor, args.steps)
        return
    for env in args.env:
        if env not in gps.TASKS:
            fail(f"unknown task {env!r}: choose from {', '.join(gps.TASKS)}")
    if not args.draw_only:
        args.runs.mkdir(parents=True, exist_ok=True)
        jobs = []
        for env in args.env:
            seeds, variants, flags = SUITE.get(env, ((1,), ("full",), "--iterations 30"))
            for variant in args.variants or variants:
                for seed in args.seeds or seeds:
                    jobs.append((args.runs / f"{env}__{variant}__{seed}", env, variant, seed, [*flags.split(), *rest]))
        with ThreadPoolExecutor(args.jobs) as pool:
            for text in pool.map(lambda job: train(*job), jobs):
                print(text, flush=True)
        write_csv(args.docs / "results" / "gps_time.csv", time_ilqr())
    collect(args)
    draw(args.docs)
    path = args.docs / "results" / "gps.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(tabulate(args.docs))
    print(f"written to {path} and {args.docs / 'gps_*.png'}")


if __name__ == "__main__":
    main()

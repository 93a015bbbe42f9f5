"""Guided policy search: runs its variants on tasks and seeds, and draws and tabulates what came of them.

    python benchmarks/gps_experiments.py                  the runs of docs/gps.md; finished ones are kept
    python benchmarks/gps_experiments.py --env hopper --cases full adaptive --seeds 1 2 --train-only    a part of them
    python benchmarks/gps_experiments.py --draw-only      only draw and tabulate what there is
    python benchmarks/gps_experiments.py --list           a command for each plan, and for each run, to run side by side
    python benchmarks/gps_experiments.py --record hop.npz --actor runs/<run>/checkpoint.pt     record a policy
    python benchmarks/gps_experiments.py --runs runs/short -- --iterations 5      what follows "--" goes to gps.py

Writes gps_runs.csv (every iteration of every run), gps_generalisation.csv (the policy, the DDP controller
and that of the nearest step, from perturbed starts and under pushes), gps_paths.csv (where the root went), their
tables in gps.md, and the pictures figures/gps_variants.png, gps_paths.png and gps_generalisation.png: Figures 2, 1 and
3 of the paper. An interrupted run is resumed.
"""

from __future__ import annotations

import json
import math
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any, get_args

import matplotlib
import numpy as np
import torch
import tyro
from common import DOCS, OUTPUT, RESULTS
from tables import ROOT, fill, markdown, origins, read_csv, write_csv
from torch import Tensor

import diffsim
from diffsim.planning import REAL, nearest_feedback
from diffsim.training import checkpoint, fail, load_policy, parse_penalty

sys.path.append(str(ROOT))
import gps  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

# What a run is called, and its flags: Figure 2's variants, adaptive guides of Section 4.2, what feedback consists of,
# and fewer samples
CASES: dict[str, str] = {variant: f"--variant {variant} --perturb 0" for variant in get_args(gps.Variant)}
CASES |= {"adaptive": "--variant full --perturb 0 --adaptive 10 --adaptive-iterations 10"}
CASES |= {"full-80": "--variant full --perturb 0"}  # on a GPU
ABLATIONS = {"only": "--imitation 1000", "unbounded": "--bound 100", "tail": "--tail 0", "narrow": "--spread 1"}
ABLATIONS |= {"stiff": "--tracking 0.05", "before": "--bound 100 --tail 0 --spread 1 --tracking 0.05"}
ABLATIONS |= {"short": "--horizon 160", "few": "--samples 4 --guiding-samples 10 --active 40"}
CASES |= {f"feedback-{name}": f"--variant feedback --perturb 0 {flags}" for name, flags in ABLATIONS.items()}
CASES |= {"feedback-start": "--variant feedback"}
CASES |= dict.fromkeys(("feedback-long", "feedback-long-cpu"), "--variant feedback --samples 20 --active 120")
ABLATED = [f"feedback-{name}" for name in ABLATIONS if name != "short"]
FIGURE_2 = [case for case in CASES if not case.startswith("feedback-")]
# On which ground the walker trains: one slope, as in Figure 3; rough ground, as in Figure 4; many terrains, with a
# guide each, and random ones of their kinds; without the random ones; without guides but that of level ground
SLOPES = "level incline:10 incline:-10 incline:5 incline:-5 step:5 step:-5"
ROUGH = "rough:10:1:1 rough:10:1:2 rough:10:2:1 rough:10:2:2"
RANDOM = "--practice incline:12 step:7 rough:12:1 rough:12:2"
GROUNDS = {"slope": "--terrain incline:10", "rough": f"--terrain {ROUGH} --practice rough:12:1 rough:12:2"}
GROUNDS |= {"terrain": f"--terrain {SLOPES} {ROUGH} {RANDOM}"}
GROUNDS |= {"guides": f"--terrain {SLOPES} {ROUGH}", "practice": RANDOM}
MORE = "--horizon 160 --guiding-samples 44 --samples 40 --active 160"
CASES |= {f"feedback-{name}": f"--variant feedback {MORE} {flags}" for name, flags in GROUNDS.items()}
FIVE, THREE, TWO, ONE = (1, 2, 3, 4, 5), (1, 2, 3), (1, 2), (1,)
OTHERS = "unregularized nonguided restart single-example dagger"
HOPPER, WALKER, SWIMMER = (
    f"--demonstration benchmarks/plans/{name}_500.npz" for name in ("hopper", "walker", "swimmer")
)
BRIEF, LONGER = "--ilqr-iterations 2", "--ilqr-iterations 40"
TERRAIN = f"--demonstration benchmarks/plans/walker_terrain_160.npz {BRIEF} --imitation 23 --iterations 26"
PLANS = {  # of benchmarks/plans/: runs of gps.py that write such a plan.npz; the swimmer's: see gps_undulation.py
    "hopper_500": "--env hopper --window 50 --restarts 8 --seed 2 --iterations 1",
    "walker_500": "--env walker --restarts 8 --ilqr-iterations 40 --iterations 1",
    "walker_terrain_160": f"--env walker --horizon 160 --terrain {SLOPES} {ROUGH} {WALKER} --ilqr-iterations 20 "
    "--samples 11 --iterations 1",
}
# What docs/gps.md shows, per task: cases, seeds, flags. Other seeds run as the first of their case
SUITE: dict[str, list[tuple[str, tuple[int, ...], str]]] = {
    "cartpole": [
        ("full", FIVE, "--iterations 24"),
        (f"{OTHERS} policy-gradient", THREE, "--iterations 24"),
    ],
    "hopper": [
        ("feedback", FIVE, f"{HOPPER} {BRIEF} --imitation 14 --iterations 19"),
        ("feedback-only", FIVE, f"{HOPPER} {LONGER} --iterations 30"),
        ("feedback-unbounded feedback-tail feedback-narrow feedback-before", TWO, f"{HOPPER} {LONGER} --iterations 20"),
        ("feedback-stiff", TWO, f"{HOPPER} {BRIEF} --imitation 16 --iterations 16"),
        ("feedback-few", TWO, f"{HOPPER} {BRIEF} --imitation 16 --iterations 22"),
        (f"full {OTHERS}", THREE, f"{HOPPER} {LONGER} --iterations 25"),
        ("policy-gradient", THREE, f"{HOPPER} {LONGER} --iterations 40"),
        ("adaptive", ONE, f"{HOPPER} {LONGER} --adaptive 5 --iterations 15"),
        ("full-80", ONE, f"{HOPPER} {BRIEF} --iterations 80 --device cuda"),
        ("feedback-start", TWO, f"{HOPPER} {BRIEF} --imitation 14 --iterations 19"),
    ],
    "walker": [
        ("feedback", FIVE, f"{WALKER} {BRIEF} --imitation 28 --iterations 31"),
        ("feedback-short", FIVE, f"{WALKER} {BRIEF} --imitation 24 --iterations 34"),
        (f"full {OTHERS} policy-gradient adaptive", THREE, f"{WALKER} {BRIEF} --horizon 160 --iterations 24"),
        ("feedback-long", FIVE, f"{WALKER} {BRIEF} --imitation 60 --iterations 90 --device cuda"),
        ("feedback-long-cpu", (2, 4), f"{WALKER} {BRIEF} --imitation 60 --iterations 150"),
        ("feedback-start", TWO, f"{WALKER} {BRIEF} --horizon 160 --imitation 24 --iterations 34"),
        ("feedback-terrain", FIVE, TERRAIN),
        ("feedback-slope feedback-rough feedback-guides feedback-practice", TWO, TERRAIN),
    ],
    "swimmer": [
        ("feedback", (1,), f"{SWIMMER} {BRIEF} --horizon 160 --hidden 200 --imitation 20 --iterations 24"),
        ("feedback", (2,), f"{SWIMMER} {BRIEF} --horizon 160 --hidden 100 --noise 0.03 --imitation 20 --iterations 24"),
        ("feedback-start", TWO, f"{SWIMMER} {BRIEF} --horizon 160 --iterations 24"),
    ],
}
RUN = ("env", "variant", "seed")
KEPT = (  # columns of progress.csv
    "iteration control_steps seconds return gps_objective gps_objective_std gps_accepted gps_regularizer gps_plan "
    "gps_guides gps_guides_std eval_objective eval_objective_std eval_without_noise eval_return eval_speed "
    "eval_length gps_ess gps_guide_share gps_guide_nats gps_near gps_estimate gps_best_estimate sim_model_steps"
).split()
PLANNED = "full", "feedback", "feedback-short", "feedback-start"  # cases whose generalisation is measured
COMPARED = "full", "feedback", "feedback-start", "feedback-few"  # cases whose samples are
TARGETS = {"cartpole": (-1000, -830, -520), "hopper": (600, 1200)}  # returns to which learners are compared
STARTS, PUSHES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), (0.5, 1.0, 2.0)
DRAWN = (*FIGURE_2, "feedback-short", "feedback-long")
COLOURS = {case: f"C{i}" for i, case in enumerate(CASES)}
CONTROLLERS = {"policy": "C0", "ddp": "C3", "tbdp": "C1"}
STYLES = {"plan": ("k", 2.0, 3), "guides": ("0.6", 0.8, 1), "policy": ("C0", 0.8, 2)}  # colour, width, order
AXES = {"cartpole": ("x (m)", "angle (rad)"), "swimmer": ("x (m)", "y (m)"), "ant": ("x (m)", "y (m)")}
Row = dict[str, Any]
Act = Callable[[int, Tensor], Tensor]
LISTED = "python benchmarks/gps_experiments.py --list"  # the commands of all runs


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = tuple(SUITE)
    """tasks"""
    seeds: tuple[int, ...] = ()
    """seeds (default: the suite's)"""
    cases: tuple[str, ...] = ()
    """variants, adaptive, wide or feedback-wide (default: the suite's)"""
    jobs: int = 1
    """runs at a time, each with one thread"""
    arguments: tyro.conf.Suppress[tuple[str, ...]] = ()  # what follows "--" on the command line
    count: int = 20
    """perturbed starts and pushes of each size"""
    runs: Path = ROOT / "runs" / "gps"
    """directory of the runs: {runs}/{env}__{case}__{seed}"""
    results: Path = OUTPUT / "cpu"
    """directory of the csv files"""
    docs: Path = OUTPUT
    """directory of gps.md, whose tables are filled, and of figures/"""
    update_results: bool = False
    """write to results/cpu and docs/ of this repository"""
    train_only: bool = False
    """only train: several such commands may run side by side"""
    list: bool = False
    """only print a command for each plan and each run"""
    draw_only: bool = False
    """train nothing: collect, draw and tabulate the runs there are"""
    record: Path | None = None
    """write a demonstration, the trajectory of --actor's deterministic policy, here; nothing else is done"""
    actor: Path | None = None
    """checkpoint of any script that --record follows"""
    steps: int = 500
    """control steps of a recording"""

    def table(self, name: str) -> Path:
        return self.results / f"gps_{name}.csv"


# Demonstrations -------------------------------------------------------------------------------------------------------


def environment(path: Path, **options: Any) -> diffsim.DiffEnv:
    """One environment, as that in which a checkpoint's policy was trained."""
    args = checkpoint.load(path)["args"]
    options |= {name: args[name] for name in ("integrator", "substeps", "theta")}
    return diffsim.make(args["env"], 1, horizon=1, penalty=parse_penalty(args["penalty"]), **options)


@torch.no_grad()
def record(path: Path, actor: Path | None, steps: int) -> None:
    """The trajectory of a script's policy from the task's unperturbed start: qpos, qvel and action."""
    if actor is None:
        fail("--record needs --actor, a checkpoint of any script")
    env = environment(actor, stochastic_init=False, early_termination=False)
    env.episode_length = steps + 1  # no reset within the recording
    policy, (obs, _) = load_policy(actor).network, env.reset()
    states, actions = [(env.qpos, env.qvel)], []
    for _ in range(steps):
        actions.append(policy(obs).clamp(-1, 1))
        obs = env.step(actions[-1])[0]
        states.append((env.qpos, env.qvel))
    qpos, qvel = (torch.cat(parts).numpy() for parts in zip(*states, strict=True))
    with path.open("wb") as file:
        np.savez(file, qpos=qpos, qvel=qvel, action=torch.cat(actions).numpy())
    print(f"{env.task.name}, {steps} control steps: {path}")


# Runs -----------------------------------------------------------------------------------------------------------------


def train(directory: Path, flags: Sequence[str], count: int) -> str:
    """Trains, or resumes, or finds that it is done, and perturbs; returns what there is to say."""
    path, (env, case, seed) = directory / "checkpoint.pt", directory.name.split("__")
    start = ["--env", env, *CASES[case].split(), "--seed", seed]
    if path.exists():
        state = checkpoint.load(path, "gps")
        if state["iteration"] >= state["args"]["iterations"]:
            return f"{directory.name}: done before"
        start = ["--resume", str(path)]
    command = [sys.executable, str(ROOT / "gps.py"), *start, "--run-dir", str(directory), "--threads", "1", *flags]
    with (directory.parent / f"{directory.name}.log").open("a") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT).returncode
    if code:
        return f"{directory.name}: exit code {code}, see {log.name}"
    measure(directory, count)
    return f"{directory.name}: done"


def jobs(args: Args) -> dict[str, list[str]]:
    """The flags of each run, by its name."""
    result = {}
    for env in args.env:
        suite = SUITE.get(env, [("full", ONE, "--iterations 30")])
        known = {(case, seed): flags for cases, seeds, flags in suite for case in cases.split() for seed in seeds}
        default, first = suite[0][2], {case: flags for cases, _, flags in reversed(suite) for case in cases.split()}
        for case in args.cases or dict.fromkeys(case for case, _ in known):
            for seed in args.seeds or [seed for own, seed in known if own == case] or ONE:
                flags = known.get((case, seed), first.get(case, default))
                result[f"{env}__{case}__{seed}"] = [*flags.split(), *args.arguments]
    return result


def train_all(args: Args) -> None:
    args.runs.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        for text in pool.map(lambda job: train(args.runs / job[0], job[1], args.count), jobs(args).items()):
            print(text, flush=True)


def commands(args: Args) -> Iterator[str]:
    """One for each plan that the runs start from, then one for each run, of one thread."""
    for name, plan in PLANS.items():
        if name.split("_")[0] in args.env:
            yield shlex.join(["python", "gps.py", *plan.split(), "--run-dir", f"runs/plans/{name}"])
    runs = args.runs.relative_to(ROOT) if args.runs.is_relative_to(ROOT) else args.runs
    rest = ["--", *args.arguments] if args.arguments else []
    for name in jobs(args):
        env, case, seed = name.split("__")
        flags = f"--env {env} --cases {case} --seeds {seed} --runs {runs} --train-only".split()
        yield shlex.join(["python", "benchmarks/gps_experiments.py", *flags, *rest])


# Generalisation -------------------------------------------------------------------------------------------------------


def load_search(path: Path) -> gps.Search:
    state = checkpoint.load(path, "gps")
    search = gps.Search(gps.Args(**state["args"]), environment(path))
    checkpoint.restore(search, state)
    return search


def measure(directory: Path, count: int) -> None:
    """Where a finished run's trajectories go and, in a case of PLANNED, what perturbations do to them."""
    search = load_search(directory / "checkpoint.pt")
    write_csv(directory / "paths.csv", paths(search))
    if directory.name.split("__")[1] in PLANNED:
        write_csv(directory / "generalisation.csv", generalisation(search, count))


def controllers(search: gps.Search) -> dict[str, Act]:
    """The policy's mean; the DDP controller; and the DDP controller of the step that looks most alike (TBDP)."""
    system, policy, guide = search.system, search.network, search.guides[0]
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        "ddp": lambda t, x: guide.mean(system, t, x),
        "tbdp": lambda _, x: nearest_feedback(system, search.guides, x, policy.obs_std)[0],
    }


def generalisation(search: gps.Search, count: int) -> list[Row]:
    """Each controller from the same perturbed starts and under the same pushes.

    A start differs by a normal vector of `size` times the standard deviation of each coordinate over the plan; a push
    changes the root's velocity along x by `size` m/s in either direction, a quarter of the time in. A trajectory is
    kept if its return is within a quarter of the guides' mean.
    """
    system, horizon, rows = search.system, search.args.horizon, []
    path = search.guides[0].x[:-1]
    spread = system.difference(path, path[:1]).std(0)
    draws = torch.randn(count, system.nd, generator=torch.Generator().manual_seed(gps.EVALUATION_SEED), dtype=REAL)
    kick = torch.zeros_like(draws)
    kick[:, system.nv] = draws[:, 0].sign()
    cases = [("start", size) for size in STARTS] + [("push", size) for size in PUSHES]
    for kind, size in cases:
        start, push = path[:1].expand(count, -1), None
        if kind == "start":
            start = system.retract(start, size * spread * draws)
        else:
            push = horizon // 4, size * kick
        for name, act in controllers(search).items():
            returns = search.measure(*system.rollout(start, horizon, act, push)).returns
            kept = returns >= search.guide_return[0] - 0.25 * abs(search.guide_return[0])
            numbers = dict(mean=returns.mean().item(), std=returns.std(correction=0).item())
            rows.append(dict(kind=kind, size=size, controller=name, **numbers, kept=kept.double().mean().item()))
    return rows


def paths(search: gps.Search, count: int = 10) -> list[Row]:
    """Where plan, guiding samples and the noisy policy's trajectories go: the first two coordinates."""
    guides = search.guides[0].sample(search.system, search.noise(count))[0]
    policy = search.roll_out(search.system, search.network.theta, search.noise(count), search.guides[0].x[:1]).x
    rows = []
    for name, x in (("plan", search.guides[0].x[None]), ("guides", guides), ("policy", policy)):
        for i, trajectory in enumerate(x[..., :2].tolist()):
            rows += [dict(what=name, number=i, step=t, x=a, y=b) for t, (a, b) in enumerate(trajectory)]
    return rows


# Tables ---------------------------------------------------------------------------------------------------------------


def number(text: str) -> float:
    return float(text) if text else math.nan


def grouped(rows: Iterable[dict[str, str]], *keys: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def collect(args: Args) -> None:
    """From the runs to the csv files; rows of runs that are not here stay as they are there."""
    tables: dict[str, list[Row]] = {"runs": [], "generalisation": [], "paths": []}
    older = set[str]()
    for directory in sorted(path for path in args.runs.glob("*__*__*") if (path / "progress.csv").is_file()):
        run = dict(zip(RUN, directory.name.split("__"), strict=True))
        horizon = json.loads((directory / "args.json").read_text())["horizon"]
        for row in read_csv(directory / "progress.csv"):
            kept = {key: f"{float(row[key]):.6g}" if row.get(key) else "" for key in KEPT}
            tables["runs"].append(run | dict(horizon=horizon) | kept)
        for name in ("generalisation", "paths"):
            tables[name] += [run | row for row in read_csv(directory / f"{name}.csv")]
            older |= {f"{line.rpartition('; ')[0]}; {LISTED}\n" for line in origins(directory / f"{name}.csv")}
    for row in tables["paths"]:
        row |= {k: f"{float(row[k]):.4g}" for k in "xy"}
    for name, rows in tables.items():
        here = {tuple(row[key] for key in RUN) for row in rows}
        rows += [row for row in read_csv(args.table(name)) if tuple(row[key] for key in RUN) not in here]
        if name == "paths":
            rows = one_run_a_task(rows)
        known = older | {line for line in origins(args.table(name)) if line.endswith(f"; {LISTED}\n")}
        write_csv(args.table(name), sorted(rows, key=lambda row: tuple(row[key] for key in RUN)), older=sorted(known))


def final_return(rows: list[dict[str, str]]) -> float:
    """Of the best policy's last evaluation; of a run that was stopped before one, its own estimate."""
    evaluated = [row["eval_objective"] for row in rows if row["eval_objective"]]
    return number(evaluated[-1] if evaluated else rows[-1]["gps_best_estimate"])


def summarise(env: str, case: str, seeds: list[list[dict[str, str]]]) -> Row:
    """One row of a case: means over its seeds, and each seed's end. In the band: at least the guides' mean - 2 std."""
    ends = [[row for row in rows if row["eval_objective"]][-1:] for rows in seeds]
    final = [final_return(rows) for rows in seeds]
    low = [number(rows[0]["gps_guides"]) - 2 * number(rows[0]["gps_guides_std"]) for rows in seeds]

    def average(column: str, place: int = 0) -> float:
        return mean(number(rows[place].get(column, "")) for rows in seeds)

    def spoken(column: str) -> str:
        values = [number(end[0][column]) for end in ends if end and end[0].get(column)]
        return f"{mean(values):.2f}" if values else ""

    return {
        "task": env,
        "case": case,
        "T": seeds[0][0]["horizon"],
        "guides": f"{average('gps_guides'):.1f} ± {average('gps_guides_std'):.1f}",
        "pretrained": f"{average('gps_objective'):.0f}",
        "end, each seed": ", ".join(f"{value:.1f}" for value in final),
        "in band": f"{sum(a >= b for a, b in zip(final, low, strict=True))} of {len(seeds)}",
        "m/s": spoken("eval_speed"),
        "steps until a fall": spoken("eval_length"),
        "iterations": f"{min(int(rows[-1]['iteration']) for rows in seeds)}",
        "control steps": f"{average('control_steps', -1):,.0f}",
        "of planning": f"{average('sim_model_steps', -1):,.0f}",
        "seconds": f"{average('seconds', -1):.0f}",
    }


def tabulate(args: Args) -> dict[str, str]:
    """The tables of docs/gps.md, by the names of their places."""
    runs, kept = grouped(read_csv(args.table("runs")), *RUN), []
    cases: dict[tuple[str, str], list[list[dict[str, str]]]] = {}
    for (env, case, _), rows in runs.items():
        cases.setdefault((env, case), []).append(rows)
    table = [summarise(env, case, seeds) for (env, case), seeds in cases.items()]
    for (env, variant, kind), rows in grouped(read_csv(args.table("generalisation")), "env", "variant", "kind").items():
        cells = dict.fromkeys(map(str, sorted({*STARTS, *PUSHES})), "")
        for (size,), own in grouped(rows, "size").items():
            shares = (mean(float(row["kept"]) for row in own if row["controller"] == name) for name in CONTROLLERS)
            cells[size] = " / ".join(f"{share:.0%}" for share in shares)
        kept.append({"task": env, "variant": variant, "perturbed": kind} | cells)
    return {
        "runs": markdown([row for row in table if row["case"] not in ABLATED]),
        "ablation": markdown([row for row in table if row["case"] in ABLATED]),
        "diagnosis": markdown(diagnose(runs)),
        "generalisation": markdown(kept),
        "samples": markdown(compare(args)),
        "swimmer": markdown(read_csv(args.table("swimmer"))),
    }


def diagnose(runs: dict[tuple[str, ...], list[dict[str, str]]]) -> list[Row]:
    """Why a search does or does not learn: a row a case, means over the last half of the iterations and the seeds."""
    table, cases = [], dict[tuple[str, ...], list[list[dict[str, str]]]]()
    for (env, case, _), rows in runs.items():
        cases.setdefault((env, rows[0]["horizon"], case), []).append(rows)
    for (env, horizon, case), seeds in cases.items():
        late = [row for rows in seeds for row in rows[len(rows) // 2 :]]
        ends = [final_return(rows) for rows in seeds]
        cells = {"nats": "gps_guide_nats", "guide share": "gps_guide_share", "ESS": "gps_ess", "near": "gps_near"}
        row = {"task": env, "T": horizon, "case": case, "seeds": len(seeds)}
        row["pretrained"] = f"{mean(number(rows[0]['gps_objective']) for rows in seeds):.1f}"
        row["end"] = f"{mean(ends):.1f}"
        row["accepted"] = f"{mean(sum(number(row['gps_accepted']) == 1 for row in rows) for rows in seeds):.1f}"
        means = {k: mean(number(row.get(name, "")) for row in late) for k, name in cells.items()}
        table.append(row | {k: "" if math.isnan(value) else f"{value:.3g}" for k, value in means.items()})
    return table


def compare(args: Args) -> list[Row]:
    """Control steps of samples until the mean return of training first passes a target: of the seeds that do, median.

    Returns are the task's own over our horizon T; an episode of another length counts as T times its mean step.
    """
    runs, table = grouped(read_csv(args.table("runs")), *RUN), []
    for env, targets in TARGETS.items():
        own = {case: [rows for (e, c, _), rows in runs.items() if (e, c) == (env, case)] for case in COMPARED}
        learners = {f"gps, {case}": seeds for case, seeds in own.items() if seeds}
        if not learners:
            continue
        first = next(iter(learners.values()))
        T, planning = float(first[0][0]["horizon"]), median(float(rows[0]["sim_model_steps"]) for rows in first)
        for name in ("shac", "ppo_baseline"):
            learners[name] = list(grouped(read_csv(args.results / f"{name}_{env}.csv"), "seed").values())
        for target in targets:
            cells = {f"gps, {case}": "" for case in COMPARED}
            for name, seeds in learners.items():
                steps = [first_pass(rows, target, T) for rows in seeds]
                reached = [count for count in steps if count < math.inf]
                cells[name] = f"{median(reached):,.0f}" if reached else "never"
                cells[name] += f" ({len(reached)} of {len(seeds)})"
            table.append({"task": env, "T": f"{T:.0f}", "return": target} | cells | {"of planning": f"{planning:,.0f}"})
    return table


def first_pass(rows: list[dict[str, str]], target: float, T: float) -> float:
    passed = (row for row in rows if number(row["return"]) * T / float(row.get("length") or T) >= target)
    return next((float(row["control_steps"]) for row in passed), math.inf)


def one_run_a_task(rows: list[Row]) -> list[Row]:
    """Every fourth step of one run of each task, of the first of these cases that there is."""
    first: dict[str, tuple[str, str]] = {}
    order = [row for case in ("feedback", "feedback-short", "full") for row in rows if row["variant"] == case]
    own = [
        row
        for row in order
        if (row["variant"], row["seed"]) == first.setdefault(row["env"], (row["variant"], row["seed"]))
    ]
    return [row for row in own if int(row["step"]) % 4 == 0]


# Pictures -------------------------------------------------------------------------------------------------------------


def draw_variants(ax: plt.Axes, env: str, runs: dict[tuple[str, ...], list[dict[str, str]]]) -> None:
    """Mean cost of the proposals: thin, each run; bold, their median; grey, two deviations of the guiding samples."""
    for variant in dict.fromkeys(case for e, case, _ in runs if e == env and case in DRAWN):
        seeds = [rows for (e, case, _), rows in runs.items() if (e, case) == (env, variant)]
        curves = [[-number(row["gps_objective"]) for row in rows] for rows in seeds]
        for curve in curves:
            ax.plot(range(len(curve)), curve, color=COLOURS[variant], lw=0.6, alpha=0.5)
        length = min(map(len, curves))
        middle = np.median([curve[:length] for curve in curves], 0)
        ax.plot(range(length), middle, color=COLOURS[variant], lw=2, label=f"{variant}, T = {seeds[0][0]['horizon']}")
        guides, std = (number(seeds[0][0][key]) for key in ("gps_guides", "gps_guides_std"))
        ax.axhspan(-guides - 2 * std, -guides + 2 * std, color="0.6", alpha=0.3, lw=0)
    ax.set(title=env, xlabel="iteration", ylabel="minus the return of the proposed policy", yscale="log")
    ax.invert_yaxis()


def draw_paths(ax: plt.Axes, env: str, rows: list[dict[str, str]]) -> None:
    for (what, count), track in grouped(rows, "what", "number").items():
        colour, width, order = STYLES[what]
        xy = [[float(row[key]) for row in track] for key in "xy"]
        ax.plot(*xy, color=colour, lw=width, zorder=order, label=what if count == "0" else None)
    ax.set(title=env, **dict(zip(("xlabel", "ylabel"), AXES.get(env, ("x (m)", "height (m)")), strict=True)))


def draw_kept(ax: plt.Axes, title: str, kind: str, rows: list[dict[str, str]]) -> None:
    for name, colour in CONTROLLERS.items():
        sizes = grouped((row for row in rows if row["controller"] == name), "size")
        kept = {float(size): 100 * mean(float(row["kept"]) for row in own) for (size,), own in sizes.items()}
        ax.plot(list(kept), list(kept.values()), "o-", color=colour, label=name)
    unit = "perturbation of the start" if kind == "start" else "push (m/s)"
    ax.set(title=title, xlabel=unit, ylabel="kept (%)", ylim=(-5, 105))


def draw(args: Args) -> None:
    runs, tracks = grouped(read_csv(args.table("runs")), *RUN), grouped(read_csv(args.table("paths")), "env")
    groups = grouped(read_csv(args.table("generalisation")), "env", "variant", "kind")
    pictures: dict[str, list[list[Callable[[plt.Axes], None]]]] = {
        "variants": [
            [partial(draw_variants, env=env, runs=runs) for env in SUITE if any(env == e for e, _, _ in runs)]
        ],
        "paths": [[partial(draw_paths, env=env, rows=rows) for (env,), rows in tracks.items()]],
        "generalisation": [
            [
                partial(draw_kept, title=f"{env}, {variant}", kind=kind, rows=rows)
                for (env, variant, k), rows in groups.items()
                if k == kind
            ]
            for kind in ("start", "push")
        ],
    }
    for name, grid in pictures.items():
        if not grid[0]:
            continue
        figure, axes = plt.subplots(
            len(grid), len(grid[0]), figsize=(4.5 * len(grid[0]), 3.6 * len(grid)), squeeze=False
        )
        for ax, panel in zip(axes.flat, chain(*grid), strict=True):
            panel(ax)
            ax.legend(fontsize=5)
        figure.tight_layout()
        (args.docs / "figures").mkdir(parents=True, exist_ok=True)
        figure.savefig(args.docs / "figures" / f"gps_{name}.png", dpi=110)
        plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    argv = [*(sys.argv[1:] if argv is None else argv), "--"]
    args = tyro.cli(Args, args=argv[: argv.index("--")], description=__doc__)
    args.arguments = tuple(argv[argv.index("--") + 1 : -1])
    if args.update_results:
        args.results, args.docs = RESULTS / "cpu", DOCS
    torch.set_num_threads(1)
    if args.record:
        record(args.record, args.actor, args.steps)
        return
    for case in args.cases:
        if case not in CASES:
            fail(f"unknown case {case!r}: choose from {', '.join(CASES)}")
    for env in args.env:
        if env not in diffsim.TASKS:
            fail(f"unknown task {env!r}: choose from {', '.join(diffsim.TASKS)}")
    if args.list:
        print("\n".join(commands(args)))
        return
    if not args.draw_only:
        train_all(args)
    if args.train_only:
        return
    collect(args)
    draw(args)
    for name, text in tabulate(args).items():
        fill(args.docs / "gps.md", f"gps {name}", text)
    print(f"written to {args.results} and {args.docs}")


if __name__ == "__main__":
    main()

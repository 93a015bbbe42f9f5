"""Guided policy search: the runs of docs/gps.md, by tasks, cases and seeds, and what came of them.

    python benchmarks/gps_experiments.py                  all runs; finished ones are kept, interrupted ones resumed
    python benchmarks/gps_experiments.py --env hopper --cases full adaptive --seeds 1 2 --train-only    a part of them
    python benchmarks/gps_experiments.py --draw-only      only draw and tabulate what there is
    python benchmarks/gps_experiments.py --list           a command for each plan, and for each run, to run side by side
    python benchmarks/gps_experiments.py --env hopper walker --temperatures      guides at several temperatures
    python benchmarks/gps_experiments.py --record hop.npz --actor runs/<run>/checkpoint.pt     record a policy

Cases, plans and the suite of docs/gps.md are in cases.json; what follows "--" goes to gps.py. Writes gps_runs.csv
(every iteration of all runs), gps_generalisation.csv (controllers from perturbed starts and under pushes), the table of
gps.md, and pictures of the paper's Figures 2 and 3.
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
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from common import CommonFlags, Line, Panel, parse, plot
from gps_variants import CASES as VARIANTS
from gps_variants import VariantArgs
from tables import ROOT, markdown, origins, read_csv, write_csv
from torch import Tensor

import diffsim
import gps
from diffsim.planning import REAL, nearest_feedback
from diffsim.planning.samples import log_mixture, log_weights
from diffsim.training import checkpoint, command, fail, load_policy, parse_penalty
from diffsim.training.evaluation import make_env

GPS = json.loads((ROOT / "benchmarks" / "cases.json").read_text())["gps"]
CASES: dict[str, str] = GPS["cases"]  # what a run is called, and its flags
PLANS: dict[str, str] = GPS["plans"]  # runs of gps.py that write a plan of benchmarks/plans/; others: results/README.md
# What docs/gps.md shows, per task: cases, seeds, flags. Other seeds run as the first of their case.
SUITE: dict[str, list[tuple[str, list[int], str]]] = GPS["suite"]
RUN = ("env", "variant", "seed")
KEPT = (  # columns of progress.csv
    "iteration control_steps seconds return gps_objective gps_objective_std gps_accepted gps_regularizer gps_plan "
    "gps_guides gps_guides_std eval_objective eval_objective_std eval_without_noise eval_return eval_speed "
    "eval_length gps_ess gps_guide_share gps_guide_nats gps_near gps_estimate gps_best_estimate sim_model_steps"
).split()
PERTURBED = "full", "feedback", "feedback-short", "feedback-start"  # cases whose generalisation is measured
SHOWN = (1, 10, 50, 500)  # of them in the page
SPREADS = (1.0, 3.0, 10.0, 30.0, 0.0)  # the last one is of eta = 1
TEMPERATURE = "env", "spread"
WEIGHED = (1, 2, 5, 10, 20, 50, 100, 200, 500)  # control steps at which weights are told
STARTS, PUSHES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), (0.5, 1.0, 2.0)
DRAWN = [*VARIANTS, "full", "paper", "adaptive", "feedback", "feedback-short", "feedback-long"]
COLOURS = [*(f"C{i}" for i in range(10)), "k", "m", "y"]
CONTROLLERS = {"policy": "C0", "ddp": "C3", "tbdp": "C1"}
Row = dict[str, Any]
Runs = dict[tuple[str, ...], list[dict[str, str]]]
Act = Callable[[int, Tensor], Tensor]
LISTED = "python benchmarks/gps_experiments.py --list"  # the commands of all runs


@dataclass
class Args(CommonFlags):
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = tuple(SUITE)  # type: ignore[assignment]
    seeds: tuple[int, ...] = ()  # seeds (default: the suite's)
    cases: tuple[str, ...] = ()  # cases (default: the suite's)
    jobs: int = 1  # runs at a time, each with one thread
    count: int = 20  # perturbed starts and pushes of each size
    runs: Path = ROOT / "runs" / "gps"  # directory of the runs: {runs}/{env}__{case}__{seed}
    train_only: bool = False  # only train: several such commands may run side by side
    temperatures: bool = False  # only sample guides of the case `paper` at several temperatures
    list: bool = False  # only print a command for each plan and each run
    record: Path | None = None  # write the trajectory of --actor's deterministic policy here; nothing else is done
    actor: Path | None = None  # checkpoint of any script that --record follows
    steps: int = 500  # control steps of a recording


# Demonstrations -------------------------------------------------------------------------------------------------------


def environment(path: Path, **options: Any) -> diffsim.DiffEnv:
    """One environment, as that in which a checkpoint's policy was trained."""
    args = checkpoint.load(path)["args"]
    options |= {name: args[name] for name in ("integrator", "substeps", "theta")}
    options["control_dt"] = args.get("control_dt")  # gps.py alone
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
        np.savez(file, qpos=qpos, qvel=qvel, action=torch.cat(actions).numpy(), control_dt=env.control_dt)
    print(f"{env.task.name}, {steps} control steps: {path}")


# Runs -----------------------------------------------------------------------------------------------------------------


def train(directory: Path, flags: Sequence[str], count: int) -> str:
    """Trains, or resumes, or finds that it is done, and perturbs; returns what there is to say."""
    path, (env, case, seed) = directory / "checkpoint.pt", directory.name.split("__")
    script = "benchmarks/gps_variants.py" if case in VARIANTS else "gps.py"
    start = ["--env", env, *CASES[case].split(), "--seed", seed]
    if path.exists():
        state = checkpoint.load(path)
        if state["iteration"] >= state["args"]["iterations"]:
            return f"{directory.name}: done before"
        start, flags = ["--resume", str(path)], list(flags)
        if "--demonstration" in flags:  # which the checkpoint has followed
            del flags[(place := flags.index("--demonstration")) : place + 2]
    line = [sys.executable, str(ROOT / script), *start, "--run-dir", str(directory), "--threads", "1", *flags]
    with (directory.parent / f"{directory.name}.log").open("a") as log:
        code = subprocess.run(line, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT).returncode
    if code:
        return f"{directory.name}: exit code {code}, see {log.name}"
    if case in PERTURBED:
        write_csv(directory / "generalisation.csv", generalisation(load_search(path), count))
    if case.startswith("paper"):
        write_csv(directory / "weights.csv", weights(load_search(path)))
    return f"{directory.name}: done"


def jobs(args: Args) -> dict[str, list[str]]:
    """The flags of each run, by its name."""
    result = {}
    for env in args.env:
        suite = SUITE.get(env, [("full", [1], "--iterations 30")])
        known = {(case, seed): flags for cases, seeds, flags in suite for case in cases.split() for seed in seeds}
        default, first = suite[0][2], {case: flags for cases, _, flags in reversed(suite) for case in cases.split()}
        for case in args.cases or dict.fromkeys(case for case, _ in known):
            for seed in args.seeds or [seed for own, seed in known if own == case] or [1]:
                flags = known.get((case, seed), first.get(case, default))
                result[f"{env}__{case}__{seed}"] = [*flags.split(), *args.arguments]
    return result


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


def load_search(path: Path) -> gps.Search:
    """The search of a checkpoint of gps.py or of gps_variants.py."""
    state = checkpoint.load(path)
    case = state["args"].get("case")
    args = VariantArgs(**state["args"]) if case else gps.Args(**state["args"])
    search = (VARIANTS[case] if case else gps.Search)(args, environment(path))
    checkpoint.restore(search, state)
    return search


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
    draws = torch.randn(count, system.nd, generator=torch.Generator().manual_seed(gps.SEED), dtype=REAL)
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


# Table and pictures ---------------------------------------------------------------------------------------------------


def weights(search: gps.Search) -> list[Row]:
    """What importance sampling rests on, at some steps t: how theta* weighs the samples of S.

    Mean log weights (nats) of the guides' samples and of its own newest, effective samples, the guides' share of the
    weight; and up to t, per step, on the guides' samples: log pi - log q_guide (nats), the distance of the actions from
    the policy's mean and the guides' deviation, in deviations of the policy's noise.
    """
    S, policy, rows = search.S.samples, search.network, []
    log_pi, guides = policy.log_prob(policy.theta, S.obs, S.u), search.S.initial
    log_w, guided = log_weights(log_pi, S.log_mixture), S.source < guides
    own, weight = (S.source == search.S.best).nonzero().flatten()[-search.args.samples :], log_w.softmax(0)
    gap = log_pi.cumsum(1) - log_mixture(S.log_q[:, :guides])
    away = ((S.u - policy.mean(policy.theta, S.obs)) / policy.sigma).square().mean(-1)
    wide = (search.guides[0].L.norm(dim=-1) / policy.sigma).square().mean(-1)
    for t in (t for t in WEIGHED if t <= search.args.horizon):
        row = dict(step=t, guides=log_w[guided, t - 1].mean(), own=log_w[own, t - 1].mean())
        row |= dict(effective=1 / weight[:, t - 1].square().sum(), share=weight[guided, t - 1].sum())
        row |= dict(gap=gap[guided, t - 1].mean() / t, away=away[guided, :t].mean().sqrt(), wide=wide[:t].mean().sqrt())
        rows.append({name: torch.as_tensor(value).item() for name, value in row.items()})
    return rows


def temperatures(env: str, count: int) -> Iterator[Row]:
    """Guides of the case `paper` by the temperature eta of exp(reward / eta), and how their trajectories end.

    `wide` is the guides' deviation in those of the policy's noise; a trajectory is kept within a quarter of the plan.
    """
    (flags,) = jobs(Args(env=(env,), cases=("paper",), seeds=(1,))).values()
    words = ["--env", env, *CASES["paper"].split(), *flags, "--device", "cpu", "--threads", "1"]
    args = gps.parse(gps.Args, words)
    search = gps.Search(args, make_env(args, 1))
    plan = search.plan("level", lambda _: None)
    search.network.sigma, best = (args.noise * plan.u[0].std(0)).clamp(min=1e-3), -plan.cost.item()
    for args.spread in SPREADS:
        (guide,) = search.guides = search.guide(search.system, plan, lambda _: None)
        returns = search.follow([guide], count).returns
        wide = (guide.L.norm(dim=-1) / search.network.sigma).square().mean().sqrt().item()
        numbers = dict(mean=returns.mean().item(), median=returns.median().item())
        kept = (returns >= best - 0.25 * abs(best)).double().mean().item()
        yield dict(env=env, spread=args.spread, eta=guide.eta.item(), wide=wide, plan=best, **numbers, kept=kept)


def number(text: str) -> float:
    return float(text or "nan")


def grouped(rows: Iterable[dict[str, str]], *keys: str) -> Runs:
    groups: Runs = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def collect(args: Args) -> None:
    """From the runs to the csv files; rows of runs that are not here stay as they are there."""
    found: dict[str, list[Row]] = {"gps_runs": [], "gps_generalisation": [], "gps_weights": []}
    older = set[str]()
    for directory in sorted(path for path in args.runs.glob("*__*__*") if (path / "progress.csv").is_file()):
        run = dict(zip(RUN, directory.name.split("__"), strict=True))
        horizon = json.loads((directory / "args.json").read_text())["horizon"]
        for row in read_csv(directory / "progress.csv"):
            kept = {key: f"{float(row[key]):.6g}" if row.get(key) else "" for key in KEPT}
            found["gps_runs"].append(run | dict(horizon=horizon) | kept)
        for name in ("generalisation", "weights"):
            path = directory / f"{name}.csv"
            found[f"gps_{name}"] += [run | row for row in read_csv(path)]
            older |= {f"{line.rpartition('; ')[0]}; {LISTED}\n" for line in origins(path)}
    for name, rows in found.items():
        here = {tuple(row[key] for key in RUN) for row in rows}
        rows += [row for row in args.read(name) if tuple(row[key] for key in RUN) not in here]
        known = older | {line for line in origins(args.csv(name)) if line.endswith(f"; {LISTED}\n")}
        write_csv(args.csv(name), sorted(rows, key=lambda row: tuple(row[key] for key in RUN)), older=sorted(known))


def final_return(rows: list[dict[str, str]]) -> float:
    """Of the best policy's last evaluation; nan of a run that was stopped before one."""
    return number(next((row["eval_objective"] for row in reversed(rows) if row["eval_objective"]), ""))


def summarise(env: str, case: str, seeds: list[list[dict[str, str]]]) -> Row:
    """One row of a case: means over its seeds, and each seed's end."""
    final = [final_return(rows) for rows in seeds]

    def average(column: str) -> float:
        return mean(number(rows[0].get(column, "")) for rows in seeds)

    iterations = sorted({int(rows[-1]["iteration"]) for rows in seeds})
    return {
        "task": env,
        "case": case,
        "T": seeds[0][0]["horizon"],
        "guides": f"{average('gps_guides'):.1f}",
        "pretrained": f"{average('gps_objective'):.0f}",
        "end, each seed": ", ".join("-" if math.isnan(value) else f"{value:.1f}" for value in final),
        "iterations": "-".join(map(str, iterations[:: len(iterations) - 1 or 1])),
    }


def table(runs: Runs) -> list[Row]:
    """One row of each task and case."""
    cases: dict[tuple[str, str], list[list[dict[str, str]]]] = {}
    for (env, case, _), rows in runs.items():
        cases.setdefault((env, case), []).append(rows)
    return [summarise(env, case, seeds) for (env, case), seeds in cases.items()]


def shown(runs: Runs) -> list[Row]:
    """Of each case, at some steps: mean log weight of the guides' samples, effective samples; medians over seeds."""
    result = list[Row]()
    for (env, case), rows in runs.items():
        line = dict(task=env, case=case)
        for (step,), own in grouped(rows, "step").items():
            if int(float(step)) in SHOWN:
                nats, effective = (median(number(row[name]) for row in own) for name in ("guides", "effective"))
                line[f"t = {float(step):.0f}"] = f"{nats:.0f} / {effective:.0f}"
        result.append(line)
    return result


def spreads(runs: Runs) -> list[Row]:
    """Of each task, by the spread of its guides: their median return, and the share that keeps the plan's."""
    result = list[Row]()
    for (env,), rows in runs.items():
        cells = {f"spread {row['spread']}" if row["spread"] != "0" else "η = 1": row for row in rows}
        shown = {name: f"{number(row['median']):.0f} ({number(row['kept']):.0%})" for name, row in cells.items()}
        result.append(dict(task=env, plan=f"{number(rows[0]['plan']):.0f}") | shown)
    return result


def variants(runs: Runs, env: str) -> Panel:
    """Mean cost of the proposals: thin, each run; bold, their median; grey, the guiding samples."""
    lines = list[Line]()
    for k, case in enumerate(DRAWN):
        seeds = [rows for key, rows in runs.items() if key[:2] == (env, case)]
        costs = [[-number(row["gps_objective"]) for row in rows] for rows in seeds]
        lines += [Line(range(len(cost)), cost, f"{COLOURS[k]}-", width=0.4) for cost in costs]
        middle = [median(values) for values in zip(*costs, strict=False)]
        lines.append(Line(range(len(middle)), middle, f"{COLOURS[k]}-", case, 2.0))
        lines += [Line((0, len(middle)), [-number(rows[0]["gps_guides"])] * 2, "0.6", width=0.8) for rows in seeds]
    return Panel(lines, env, "iteration", "cost of the proposal", log="y")


def kept(rows: list[dict[str, str]], title: str, kind: str) -> Panel:
    """The share of trajectories that keep the guides' return, by the size of the perturbation."""
    lines = []
    for name, colour in CONTROLLERS.items():
        sizes = grouped((row for row in rows if row["controller"] == name), "size")
        shares = [100 * mean(float(row["kept"]) for row in own) for own in sizes.values()]
        lines.append(Line([float(size) for (size,) in sizes], shares, f"{colour}o-", name))
    return Panel(lines, title, "perturbation of the start" if kind == "start" else "push (m/s)", "kept (%)", zero=True)


@command
def main(argv: Sequence[str] | None = None) -> None:
    args = parse(Args, __doc__, argv)
    if args.record:
        record(args.record, args.actor, args.steps)
        return
    for words, known in ((args.cases, CASES), (args.env, diffsim.TASKS)):
        if unknown := [word for word in words if word not in known]:
            fail(f"unknown {unknown[0]!r}: choose from {', '.join(known)}")
    if args.list:
        print("\n".join(commands(args)))
        return
    if args.temperatures:
        args.merge("gps_temperatures", [row for env in args.env for row in temperatures(env, args.count)], TEMPERATURE)
        return
    if not args.draw_only:
        args.runs.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(args.jobs) as pool:
            for text in pool.map(lambda job: train(args.runs / job[0], job[1], args.count), jobs(args).items()):
                print(text, flush=True)
    if args.train_only:
        return
    collect(args)
    runs = grouped(args.read("gps_runs"), *RUN)
    args.publish("gps runs", markdown(table(runs)), "gps.md")
    args.publish("gps weights", markdown(shown(grouped(args.read("gps_weights"), *RUN[:2]))), "gps.md")
    args.publish("gps temperatures", markdown(spreads(grouped(args.read("gps_temperatures"), "env"))), "gps.md")
    plot(args.picture("gps_variants"), [[variants(runs, env) for env in SUITE if any(env == key[0] for key in runs)]])
    groups = grouped(args.read("gps_generalisation"), "env", "variant", "kind")
    grid = [
        [kept(rows, f"{env}, {case}", kind) for (env, case, own), rows in groups.items() if own == kind]
        for kind in ("start", "push")
    ]
    plot(args.picture("gps_generalisation"), grid)


if __name__ == "__main__":
    main()

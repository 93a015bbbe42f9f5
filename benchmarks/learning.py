"""Learning: trains learners on tasks and seeds, evaluates the final policies, and draws and tabulates all of it.

    python benchmarks/learning.py --env ant --seeds 1 2 3              train (finished runs are kept), evaluate, draw
    python benchmarks/learning.py --experiment orders                  several learners beside each other, likewise
    python benchmarks/learning.py --experiment orders --time-limit 500    stop in time; the same command goes on
    python benchmarks/learning.py --experiment orders --draw-only      only draw and tabulate what there is
    python benchmarks/learning.py --runs runs/short -- --iterations 50 what follows "--" goes to the learner

Learners (a script with flags), experiments (learners on tasks, the first is what the others are compared with) and the
returns to compare are in cases.json. Writes {learner}_{env}.csv (about 100 points of each run), learning.csv (a line
for each learner and task), pictures of the learner or the experiment, and with --update-results the tables of their
pages. Each final policy is evaluated where it was trained, explicitly with four times the substeps, and explicitly with
four times the task's default.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import mean, median, pstdev
from typing import NamedTuple

import common
import numpy as np
from common import LEARNT, Line, Panel, Tasks, check_names, plot, run
from runner import COLUMNS, Case, Curve, Runner, ScriptFlags, curve, folders, passing, seed, summary
from tables import ROOT, Row, markdown, read_csv

from diffsim.training import Count, fail


class Returns(NamedTuple):
    """A task's returns; those published are of Georgiev et al. 2024, "Adaptive Horizon Actor-Critic", 10 seeds."""

    target: int  # to which learners are compared
    timed: Sequence[int] = ()  # those whose passing is timed
    published: Mapping[str, int] = {}  # by learner: SHAC's and PPO's
    record: int | None = None  # the best published of any learner (AHAC's), timed for SAPO


class Experiment(NamedTuple):
    """Several learners beside each other."""

    title: str
    learners: Sequence[str]
    tasks: Sequence[str]
    page: str = "experiments.md"
    table: str = ""  # its name in the page (default: the experiment's)
    picture: str | None = None  # its file (default: the experiment's name; "": no picture)
    columns: Sequence[str] = ()  # the table is these of learning.csv instead of what the curves say
    shown: Sequence[str] = ()  # learners of that table (default: all)


CASES = json.loads(Path(__file__).with_name("cases.json").read_text())
RETURNS = {name: Returns(**case) for name, case in CASES["returns"].items()}
LEARNERS: dict[str, str] = CASES["learners"]  # script and flags
EXPERIMENTS = {name: Experiment(**case) for name, case in CASES["experiments"].items()}
POINTS = 100  # kept of each run
PAIRS = {name: (f"pfpn_{name}", f"pfpn_gaussian_{name}") for name in ("ppo", "shac", "sac")}  # by their algorithms


@dataclass
class Args(ScriptFlags):
    env: Tasks = LEARNT  # tasks
    algorithm: str = "shac"  # learner: a script in the repository's root, without .py, or one of cases.json
    experiment: str = ""  # several learners beside each other, by the experiment's name in cases.json
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds of each
    jobs: Count = 1  # runs at a time; they share the device, which slows each of them down
    evaluate_only: bool = False  # train nothing: evaluate the runs there are, finished or not


def collect(args: Args, learner: str, env: str) -> None:
    """Write about POINTS rows of each of a task's runs, and the summary of those that have been evaluated."""
    points, returns = list[Row](), RETURNS[env]
    for folder in folders(args.runs / learner, env):
        rows = read_csv(folder / "progress.csv")
        values = np.array([float(row.get("return") or "nan") for row in rows])
        if np.isnan(values).all():
            continue
        keep = {*np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int)}
        keep |= {np.nanargmax(values), *np.flatnonzero(values >= returns.target)[:1]}
        keep |= {k for k, row in enumerate(rows) if row.get("eval_return")}
        for row in (rows[k] for k in sorted(keep)):
            points.append({"seed": seed(folder)} | {c: row.get(c) and f"{float(row[c]):.6g}" or "" for c in COLUMNS})
    args.write(f"{learner}_{env}", points)
    timed = {*returns.timed, *([returns.record] if returns.record and learner.startswith("sapo") else [])}
    if found := summary(args.runs / learner, env, sorted(timed)):
        row = {"learner": learner, "task": env} | found | {"published": returns.published.get(learner, "")}
        args.replace("learning", [row], ("learner", "task"))


def curves(args: Args, learner: str, env: str) -> list[Curve]:
    """The curve of each seed from this machine's csv file, else from another one's (a GPU's first), without seconds.

    The file is the learner's on the task, or else curves.csv, which paper.py writes.
    """
    seeds: dict[str, list[dict[str, str]]] = {}
    cells = [row for row in args.read("curves") if (row["learner"], row["task"]) == (learner, env)]
    rows = args.read(name := f"{learner}_{env}") or cells
    if not rows and args.directory.parent == common.RESULTS:
        paths = sorted(common.RESULTS.glob(f"*/{name}.csv"), key=lambda path: (path.parent.name == "cpu", path))
        rows = [row | {"seconds": ""} for path in paths[:1] for row in read_csv(path)]
    for row in rows:
        seeds.setdefault(row["seed"], []).append(row)
    return [curve(rows) for rows in seeds.values()]


def timed(runs: Sequence[Curve]) -> list[Curve]:
    """The runs that had the machine to themselves. The csv files have no seconds of the others."""
    return [run for run in runs if not np.isnan(run["seconds"]).any()]


def spread(values: Sequence[float]) -> str:
    return f"{mean(values):.0f} ± {pstdev(values):.0f}" if len(values) > 1 else f"{values[0]:.0f}"


def table(args: Args, learners: Sequence[str], tasks: Sequence[str]) -> list[Row]:
    """The learners beside each other, on tasks where there are two."""
    rows = list[Row]()
    for env in tasks:
        found = {learner: runs for learner in learners if (runs := curves(args, learner, env))}
        target = RETURNS[env].target
        for learner, runs in found.items() if len(found) > 1 else ():
            last = [values[-1] for run in runs if len(values := run["eval_return"][~np.isnan(run["eval_return"])])]
            own = timed(runs)
            steps = median(passing(runs, target, "control_steps"))
            seconds = median(passing(own, target, "seconds")) if own else math.nan
            rows.append(
                {
                    "task": env,
                    "learner": learner,
                    "seeds": len(runs),
                    "best return of training": spread([np.nanmax(run["return"]) for run in runs]),
                    "published": RETURNS[env].published.get(learner, ""),
                    "last evaluation": f"{median(last):.0f}" if last else "",
                    "control steps": f"{median(run['control_steps'][-1] for run in runs) / 1e6:.3g} M",
                    "training, s": f"{median(run['seconds'][-1] for run in own):.0f}" if own else "",
                    "target": target,
                    "steps to target": "never" if steps == math.inf else f"{steps / 1e6:.3g} M",
                    "s to target": "" if not own else "never" if seconds == math.inf else f"{seconds:.0f}",
                }
            )
    return rows


def ratios(args: Args, learners: Sequence[str], tasks: Sequence[str]) -> list[Row]:
    """PFPN's best return over the Gaussian policy's, by algorithm, within the control steps that all runs made."""
    rows = list[Row]()
    for env, (algorithm, names) in product(tasks, PAIRS.items()):
        both = [curves(args, name, env) for name in names if name in learners]
        if len(both) == 2 and all(both):
            end = min(run["control_steps"][-1] for runs in both for run in runs)
            best = [[np.nanmax(run["return"][run["control_steps"] <= end]) for run in runs] for runs in both]
            row: Row = {"task": env, "algorithm": algorithm, "control steps": f"{end / 1e6:.3g} M"}
            row = {**row, "PFPN": spread(best[0]), "Gaussian": spread(best[1])}
            rows.append({**row, "PFPN / Gaussian": f"{mean(best[0]) / mean(best[1]):.2f}"})
    return rows


def draw(path: Path, learners: Sequence[str], tasks: Sequence[str], of: Callable[[str, str], list[Curve]]) -> None:
    """Each seed (thin) and the median (bold) against control steps and seconds, on log axes if ends lie far apart.

    Args:
        of: the curves of a learner on a task.
    """
    grid = list[list[Panel]]()
    for x, text in (("control_steps", "control steps"), ("seconds", "seconds of training")):
        panels = list[Panel]()
        for env in tasks:
            lines, begins, ends, published = list[Line](), list[float](), list[float](), RETURNS[env].published
            for k, learner in enumerate(learners):
                runs = of(learner, env)
                if runs := timed(runs) if x == "seconds" else runs:
                    shared = np.geomspace(max(run[x][0] for run in runs), min(run[x][-1] for run in runs), 400)
                    middle = np.median([np.interp(shared, run[x], run["return"]) for run in runs], axis=0)
                    lines += [Line(run[x], run["return"], f"C{k}-", width=0.5) for run in runs]
                    lines.append(Line(shared, middle, f"C{k}-", learner, width=2))
                    begins.append(shared[0])
                    ends.append(shared[-1])
            for learner in (learner for learner in learners if ends and learner in published):
                value, style = [published[learner]] * 2, f"C{learners.index(learner)}--"
                lines.append(Line((min(begins), max(ends)), value, style, f"{learner}, published", 0.8))
            log = "x" if ends and max(ends) > 10 * min(ends) else ""
            panels.append(Panel(lines, env, text, "" if panels else "return of training episodes", log))
        if any(panel.lines for panel in panels):  # not where all runs shared their machine, and have no seconds
            grid.append(panels)
    plot(path, grid, (3.4, 2.9) if len(tasks) > 1 else (6.0, 3.8))


def summaries(args: Args, learners: Sequence[str], tasks: Sequence[str]) -> list[dict[str, str]]:
    """Lines of learning.csv, of all machines."""
    rows = [
        {"machine": machine} | row
        for machine, path in args.machines("learning").items()
        for row in read_csv(path)
        if row["learner"] in learners and row["task"] in tasks
    ]
    return sorted(rows, key=lambda row: (tasks.index(row["task"]), learners.index(row["learner"])))


def report(args: Args, name: str) -> None:
    """An experiment's table and picture, from the csv files."""
    case = EXPERIMENTS[name]
    table_name, picture = case.table or name, name if case.picture is None else case.picture
    if case.columns:
        everywhere, rows = "machine" in case.columns, summaries(args, case.shown or case.learners, case.tasks)
        rows = [row for row in rows if everywhere or row["machine"] == args.directory.name]
        args.publish(table_name, markdown(rows, case.columns), case.page, everywhere)
        compared = [*case.tasks]
    else:
        beside, found = ratios(args, case.learners, case.tasks), table(args, case.learners, case.tasks)
        parts = [beside] if {*case.learners} <= {*chain(*PAIRS.values())} else [found, beside]
        text = "".join(f"{markdown(part)}\n" for part in parts if part)
        args.publish(table_name, f"{text}![{case.title}]({args.link(picture)})\n", case.page)
        compared = [env for env in case.tasks if env in {row["task"] for row in found}]
    if picture and compared:
        draw(args.picture(picture), case.learners, compared, partial(curves, args))


def main(args: Args) -> None:
    if args.experiment:
        check_names("--experiment", [args.experiment], EXPERIMENTS)
    case = EXPERIMENTS[args.experiment] if args.experiment else Experiment("", (args.algorithm,), LEARNT)
    scripts = {learner: LEARNERS.get(learner, learner).split() for learner in case.learners}
    if missing := [script for script, *_ in scripts.values() if not (ROOT / f"{script}.py").is_file()]:
        fail(f"--algorithm: no script {missing[0]}.py in {ROOT}; choose one, or from {', '.join(LEARNERS)}")
    tasks = [env for env in args.env if env in case.tasks]
    if not args.draw_only:
        cases = (
            Case(args.runs / learner / f"{env}__{seed}", env, seed, script, tuple(flags))
            for seed in args.seeds
            for env in tasks
            for learner, (script, *flags) in scripts.items()
        )
        Runner(args, args.jobs).run(cases, args.evaluate_only)
    for learner, env in product(case.learners, tasks):
        collect(args, learner, env)
    if args.experiment:
        return report(args, args.experiment)
    learner = args.algorithm
    there = [env for env in LEARNT if curves(args, learner, env)]
    draw(args.picture(learner), case.learners, there, partial(curves, args))


if __name__ == "__main__":
    run(main, Args, __doc__)

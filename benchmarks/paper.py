"""The paper's results as one list of cells: a learner on a task with a seed, trained to its end, alone.

    python benchmarks/paper.py --check                             what is missing
    python benchmarks/paper.py --only headline --update-results    this machine's missing cells, then the tables
    python benchmarks/paper.py --learners sapo --train-only        on a machine that is lent: bring runs/paper home
    python benchmarks/paper.py --pace 100                          there, alone: the seconds of an iteration
    python benchmarks/paper.py --machine h200 --evaluate-only --update-results    and evaluate there
    python benchmarks/paper.py --draw-only --update-results        only the tables and pictures
    python benchmarks/paper.py --same REVISION --update-results    record whether this revision trains the same policies

Groups of cells are in cases.json: learners on tasks of a machine, by seeds. A cell counts while no revision since its
own has changed its numbers (fingerprints.py). Writes cells.csv, a line for each, and curves.csv, some POINTS of each
training that a picture shows; a table has the learners whose seeds are all there. On a GPU trainings may run side by
side (--shared): their seconds are then those of pace.csv, of iterations that had the GPU alone.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median

import cells
import common
import fingerprints
import numpy as np
from cells import GROUPS, LEARNERS, RETURNS, Cell, Curve, Group, Runner, ScriptFlags, curve, evaluation, read_cells
from common import LEARNT, NAMES, Line, Panel, Tasks, check_names, colours, plot, run
from tables import ROOT, Cells, Row, grouped, markdown, middle, numbers, ranged, read_csv, tell

import diffsim
from diffsim.training import Natural, checkpoint

KEY = ("learner", "task", "seed")
POINTS = 50  # of a curve
# Columns of a task's table on a page.
TIMED = ("learner", "return", "training (s)", "seed 1 in all (s)", "s to target", "M steps to target", "falls")


@dataclass
class Args(ScriptFlags):
    env: Tasks = LEARNT  # tasks
    runs: Path = ROOT / "runs" / "paper"  # directory of the runs: {runs}/{machine}/{learner}/{task}__{seed}
    only: tuple[str, ...] = tuple(name for name in GROUPS if not GROUPS[name].older)  # groups
    learners: tuple[str, ...] = ()  # learners (default: all of a group)
    seeds: tuple[int, ...] = ()  # seeds (default: all of a group)
    check: bool = False  # only say what is missing
    train_only: bool = False  # evaluate nothing
    evaluate_only: bool = False  # train nothing
    pace: Natural = 0  # train so many iterations alone, and write what each takes to pace.csv
    shared: bool = False  # the machine did other work beside the trainings: their seconds are left out
    same: str = ""  # a revision: only say whether this one trains the same policies
    reason: str = ""  # with --same: why some differ

    def alone(self, cell: Cell) -> bool:
        """Whether a cell's seconds mean something."""
        return cell.timed and not self.shared

    def group(self, name: str) -> Group:
        """On this machine's GPU, if it has one and the group is of a GPU."""
        group = GROUPS[name]
        return group if "cpu" in (self.place, group.machine) else group._replace(machine=self.place)


def wanted(args: Args) -> Iterator[Cell]:
    """Each once, those of seed 1 of all groups first."""
    found = {
        (seed, Cell(group.machine, learner, task, seed)): None
        for group in map(args.group, args.only)
        for learner in group.learners
        for task in group.tasks
        for seed in range(1, group.seeds + 1)
        if task in args.env and seed in (args.seeds or [seed]) and learner in (args.learners or [learner])
    }
    return (cell for _, cell in sorted(found, key=lambda each: each[0]))


def measure_pace(args: Args, runner: Runner, cell: Cell) -> Row:
    """Of the second half of --pace iterations; empty if they are not there."""
    case = cell.case(args.runs / "pace")
    if not args.evaluate_only:
        cells.begin(runner, cell, case)
        runner.train(case, args.pace)
    seconds = [float(row["seconds"]) for row in read_csv(case.folder / "progress.csv")]
    if len(seconds) < 2:
        return {}
    half = len(seconds) // 2
    each = (seconds[-1] - seconds[half - 1]) / (len(seconds) - half)
    about = dict(zip(KEY[:2], cell[1:3], strict=True)) | json.loads((case.folder / "cell.json").read_text())
    return about | {"iterations": len(seconds), "start (s)": seconds[-1] - len(seconds) * each, "iteration (s)": each}


def measure(args: Args, runner: Runner, cell: Cell) -> Row:
    """A cell's line: what its training and its evaluation say; empty if it is not whole."""
    case = cell.case(args.runs)
    path = case.folder / "checkpoint.pt"
    if not path.is_file() or not (case.folder / "cell.json").is_file():
        return {}
    state = checkpoint.load(path)
    begun = json.loads((case.folder / "cell.json").read_text())
    if state["iteration"] < state["args"]["iterations"] or not runner.evaluate(case):
        return {}
    own = evaluation(case.folder)
    progress, returns = read_csv(case.folder / "progress.csv"), RETURNS[cell.task]
    row: dict[str, object] = dict(zip(KEY, cell[1:], strict=True)) | begun
    row |= {"iterations": state["iteration"], "control steps": float(progress[-1]["control_steps"])}
    row |= {"training (s)": float(progress[-1]["seconds"]), "return": own["return"]}
    row |= {"speed": "" if own["speed"] is None else own["speed"]}
    row |= {"falls": mean(length < diffsim.TASKS[cell.task].episode_length for length in own["lengths"])}
    row |= {"kept": own["finer"]["kept"]}
    for target in returns.timed or (returns.target,):
        for x in ("control_steps", "seconds"):
            row[f"{x} to {target}"] = cells.passing(curve(progress), target, x)
    if not args.alone(cell):
        row |= dict.fromkeys([name for name in row if "(s)" in name or name.startswith("seconds")], "")
    return row


def points(args: Args, cell: Cell) -> list[Row]:
    """Some POINTS of a cell's training, from its first finished episode on."""
    rows = [row for row in read_csv(cell.case(args.runs).folder / "progress.csv") if row.get("return")]
    chosen = np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int)
    columns = ("iteration", "control_steps", *(("seconds",) if args.alone(cell) else ()), "return")
    about = dict(zip(KEY, cell[1:], strict=True))
    return [about | {name: rows[k][name] for name in columns} for k in chosen]


def curves(args: Args, name: str) -> dict[tuple[str, str], list[Curve]]:
    """By learner and task, of a group's seeds, where all of them are there; with seconds if the group is timed."""
    group = args.group(name)
    directory = args.directory.parent / group.machine
    rows, known = read_csv(directory / "curves.csv"), cells.paces(directory)
    for row in rows:
        pace = known.get((row["learner"], row["task"]))
        if pace and not row["seconds"]:
            row["seconds"] = str(pace(float(row["iteration"])))
        row["seconds"] = row["seconds"] if group.timed else ""
    found = dict[tuple[str, str], list[Curve]]()
    for (learner, task, seed), own in grouped(rows, *KEY).items():
        if learner in group.learners and task in group.tasks and int(seed) <= group.seeds:
            found.setdefault((learner, task), []).append(curve(own))
    return {key: runs for key, runs in found.items() if len(runs) == group.seeds}


def panel(group: Group, found: Mapping[tuple[str, str], list[Curve]], task: str, x: str) -> Panel:
    """Each seed (thin) and the median (bold) against control steps or seconds, on a log axis if ends lie far apart."""
    lines, begins, ends = list[Line](), list[float](), list[float]()
    colour = colours(group.learners)
    for learner in group.learners:
        runs = [run for run in found.get((learner, task), []) if not np.isnan(run[x]).any()]
        if not runs:  # or none that had its machine alone, and has seconds
            continue
        begins.append(min(run[x][0] for run in runs))
        ends.append(min(run[x][-1] for run in runs))
        shared, middle = median_curve(runs, x, ends[-1])
        lines += [Line(run[x], run["return"], f"{colour[learner]}-", width=0.5) for run in runs]
        lines.append(Line(shared, middle, f"{colour[learner]}-", NAMES.get(learner, learner), width=2))
    for learner, value in RETURNS[task].published.items():
        if ends and learner in group.learners:
            style, name = f"{colour[learner]}--", f"{NAMES[learner]}, published"
            lines.append(Line((min(begins), max(ends)), [value] * 2, style, name, 0.8))
    log = "x" if ends and max(ends) > 10 * min(ends) else ""
    text = {"control_steps": "control steps", "seconds": "seconds of training"}[x]
    return Panel(lines, task, text, "return of training episodes" if task == group.tasks[0] else "", log)


def median_curve(runs: Sequence[Curve], x: str, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Places on x and the median there. A seed that has not begun counts as the lowest."""
    shared = np.geomspace(min(run[x][0] for run in runs), end, 400)
    values = np.median([np.interp(shared, run[x], run["return"], left=-np.inf) for run in runs], axis=0)
    return shared[begun := np.isfinite(values)], values[begun]


def pictured(args: Args, name: str) -> None:
    """Draw the curves of learners whose seeds are all there, of tasks that have any."""
    group, found = args.group(name), curves(args, name)
    tasks = [task for task in group.tasks if any((learner, task) in found for learner in group.learners)]
    group = group._replace(tasks=tasks)
    grid = [[panel(group, found, task, x) for task in tasks] for x in ("control_steps", "seconds")]
    grid = [panels for panels in grid if any(panel.lines for panel in panels)]
    if grid:
        size = (3.4, 2.9) if len(tasks) > 1 else (6.0, 3.8)
        plot(replace(args, machine=group.machine).picture(name), grid, size)


def ratios(args: Args, name: str) -> list[Row]:
    """The best return of a group's first learner over that of its second, within the control steps that all made."""
    (first, second), found, rows = GROUPS[name].learners, curves(args, name), list[Row]()
    for task in GROUPS[name].tasks:
        both = [found.get((learner, task), []) for learner in (first, second)]
        if all(both):
            end = min(run["control_steps"][-1] for runs in both for run in runs)
            best = [[float(np.nanmax(run["return"][run["control_steps"] <= end])) for run in runs] for runs in both]
            row: dict[str, object] = {"task": task, "control steps": f"{end / 1e6:.3g} M"}
            names = (NAMES.get(learner, learner) for learner in (first, second))
            row |= {name: cells.spread(values) for name, values in zip(names, best, strict=True)}
            rows.append(row | {"ratio": f"{mean(best[0]) / mean(best[1]):.2f}"})
    return rows


def line(rows: Sequence[Cells]) -> Row:
    """Show all seeds of a learner on a task: medians, of the return and of the seconds to the target also the range, of
    the falls the most. Seconds that were computed from an iteration's have a mark."""
    returns, task = numbers(rows, "return"), rows[0]["task"]
    shown: dict[str, object] = {"task": task, "learner": rows[0]["learner"]}
    shown["return"] = ranged(returns, ".0f")
    shown["training (s)"] = middle(rows, "training (s)", ".0f") + max(row.get("paced", "") for row in rows)
    shown |= {"falls": f"{max(numbers(rows, 'falls')):.2f}"}
    target = RETURNS[task].target
    shown["s to target"] = ranged(numbers(rows, f"seconds to {target}"), ".0f")
    steps = numbers(rows, f"control_steps to {target}")
    return shown | {"M steps to target": tell(median(steps) / 1e6, ".3g") if steps else ""}


def by_task(rows: Sequence[Row]) -> str:
    """A table for each task that has several learners, under its name and target; a single one compares nothing."""
    text = list[str]()
    for task, count in Counter(row["task"] for row in rows).items():
        own = [
            {**row, "learner": NAMES.get(str(row["learner"]), row["learner"])} for row in rows if row["task"] == task
        ]
        if count > 1:
            text.append(f"**{task}**, target {RETURNS[str(task)].target:,}\n\n{markdown(own, TIMED)}")
    return "\n".join(text) or "(none yet)\n"


def table(args: Args, name: str) -> list[Row]:
    """A line for each learner and task of which all seeds are there, of one revision and one kind of machine."""
    group, lines = args.group(name), list[Row]()
    rows, total = read_cells(args.directory.parent / group.machine), totals(args, group)
    for task in group.tasks:
        for learner in group.learners:
            seeds = max(each.seeds for each in Cell(group.machine, learner, task, 1).groups)  # the same in all tables
            own = [row for row in rows if (row["learner"], row["task"]) == (learner, task)]
            own = [row for row in own if int(row["seed"]) <= seeds and cells.counts(row, group.timed)]
            if len(own) == seeds and len({row["trained on"] for row in own}) == 1:
                lines.append({**line(own), "seed 1 in all (s)": total.get((learner, task), "")})
    return lines


def totals(args: Args, group: Group) -> dict[tuple[str, str], str]:
    """In all (s) of seed 1 by learner and task."""
    rows = read_csv(args.directory.parent / group.machine / "cells.csv")
    rows = [row for row in rows if row["seed"] == "1" and row["in all (s)"] and cells.counts(row, group.timed)]
    return {(row["learner"], row["task"]): f"{float(row['in all (s)']):.0f}" for row in rows}


def printed(args: Args, name: str) -> str:
    """A group's tables: a line for each learner, or for each task the ratio of two learners."""
    return markdown(ratios(args, name)) if GROUPS[name].ratios else by_task(table(args, name))


def check(args: Args) -> str:
    """What is missing, a line for each learner and task."""
    lines, missing, count = list[str](), dict[tuple[str, str, str], list[Cell]](), 0
    known = {name: read_cells(common.RESULTS / name) for name in {cell.machine for cell in wanted(args)}}
    for cell in wanted(args):
        count += 1
        if not cells.done(known[cell.machine], cell):
            missing.setdefault(cell[:3], []).append(cell)
    for each in missing.values():
        seeds = " ".join(str(cell.seed) for cell in each)
        lines.append(f"{each[0].machine}: {each[0].command.replace(f'--seed {each[0].seed}', f'--seed {{{seeds}}}')}")
    lines.append(f"{sum(map(len, missing.values()))} of {count} cells are missing")
    lines += [unrecorded] if (unrecorded := fingerprints.open_end()) else []
    return "\n".join(lines)


def main(args: Args) -> None:
    check_names("--only", args.only, GROUPS)
    check_names("--learners", args.learners, LEARNERS)
    if args.check:
        print(check(args))
        return
    if args.same:
        fingerprints.record(args, args.same, args.reason)
        return
    runner = Runner(args)
    for cell in () if args.draw_only else wanted(args):
        if cell.machine != args.place:
            continue
        if args.pace:
            if cell.seed == 1 and (row := measure_pace(args, runner, cell)):
                args.keep("pace", row, KEY[:2])
            continue
        if cells.done(read_cells(args.directory), cell):
            continue
        if not args.evaluate_only and not cells.train(runner, cell):
            continue
        if not args.train_only and (row := measure(args, runner, cell)):
            args.keep("cells", row, KEY)
            if any(group.picture for group in cell.groups):
                args.replace("curves", points(args, cell), KEY)
    for name in args.only:
        shown = printed(args, name)
        args.publish(name, shown, GROUPS[name].page if "|" in shown else "", everywhere=True)
        if GROUPS[name].picture:
            pictured(args, name)


if __name__ == "__main__":
    run(main, Args, __doc__)

"""Trainings that are compared by what their progress says: PFPN's dog, guided policy search, trials of PPO, GPUs.

    python benchmarks/suites.py                                  all of cases.json; what has finished is kept
    python benchmarks/suites.py --only walker --cells full adaptive --seeds 1
    python benchmarks/suites.py --draw-only --update-results     only the tables

A suite of cases.json has groups of runs, each a table of a page. It says which numbers of progress.csv are a run's line
of the csv file, and how a table's line shows those of all seeds. What follows "--" goes to the scripts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import NamedTuple

from cells import Case, Runner, ScriptFlags, spread
from common import TASKS, Tasks, check_names, run
from tables import Cells, Row, grouped, markdown, numbers, read_csv
from tyro.conf import Suppress

KEY = ("group", "cell", "seed")
READ: dict[str, Callable[[Sequence[float]], float]] = {
    "first": lambda values: values[0],
    "last": lambda values: values[-1],
    "mean": mean,
    "middle": median,
    "most": max,
    "sum": sum,
}
SHOW: dict[str, Callable[[Sequence[float]], str]] = {
    "mean": lambda values: f"{mean(values):.0f}",
    "thousandths": lambda values: f"{1e3 * mean(values):.0f}",
    "spread": spread,
    "share": lambda values: f"{max(values):.0%}",
    "percent": lambda values: f"{mean(values):.1%}",
    "each": lambda values: ", ".join(f"{value:.1f}" for value in values),
    "each, rounded": lambda values: ", ".join(f"{value:.0f}" for value in values),
    "all": lambda values: "-".join(dict.fromkeys(f"{value:.0f}" for value in (min(values), max(values)))),
}


class Suite(NamedTuple):
    csv: str
    page: str
    columns: dict[str, tuple[str, str]]  # of the csv file: how to READ which column of progress.csv; flags, feet
    table: dict[str, tuple[str, str]]  # how to SHOW which column of the csv file
    cells: dict[str, str]  # flags by the cells' names
    groups: dict[str, list[tuple[list[str], list[int], str]]]  # cells, seeds, and their script, task and other flags
    across: bool = False  # one table of all groups
    unshown: tuple[str, ...] = ()  # groups that the page has no table of
    machine: str = "cpu"  # the folder of results/ that has the csv file


SUITES = {
    name: Suite(**case)
    for name, case in json.loads(Path(__file__).with_name("cases.json").read_text())["suites"].items()
}
GROUPS = {group: name for name, suite in SUITES.items() for group in suite.groups}


@dataclass
class Args(ScriptFlags):
    env: Suppress[Tasks] = TASKS
    device: str = "cpu"  # torch device of the runs
    runs: Path = ScriptFlags.runs.parent  # directory of the runs: {runs}/{suite}/{group}__{cell}__{seed}
    only: tuple[str, ...] = tuple(GROUPS)  # groups
    cells: tuple[str, ...] = ()  # cells (default: all of a group)
    seeds: tuple[int, ...] = ()  # seeds (default: all of a cell)
    train_only: bool = False  # write no csv: several such commands may run side by side


def cases(args: Args, group: str) -> Iterator[tuple[str, Case]]:
    """Cells and what their runs are."""
    suite = SUITES[GROUPS[group]]
    for names, seeds, command in suite.groups[group]:
        script, task, *flags = command.split()
        for cell in (name for name in names if name in (args.cells or names)):
            for seed in args.seeds or seeds:
                folder = args.runs / GROUPS[group] / f"{group}__{cell}__{seed}"
                yield cell, Case(folder, task, seed, script, (*flags, *suite.cells[cell].split()))


def line(suite: Suite, folder: Path) -> dict[str, object]:
    """What the progress of a run says; empty if it has not been evaluated."""
    rows = read_csv(folder / "progress.csv")
    if not any(numbers(rows, column) for column in ("eval_return", "eval_objective")):
        return {}
    found = dict[str, object]()
    for name, (how, column) in suite.columns.items():
        values = numbers(rows, column)
        if how in OTHERS:
            values = [OTHERS[how](folder, column)]
        found[name] = f"{READ.get(how, mean)(values):.6g}" if values else ""
    return found


def core_seconds(folder: Path) -> float:
    """Seconds of CPU time that a run took so far, of all its calls."""
    return sum(map(float, (folder / "core_seconds.txt").read_text().split()))


def feet(folder: Path) -> int:
    """On how many feet a run's policy moves: their duty factors are at least half of the largest."""
    duty = [float(row["value"]) for row in read_csv(folder / "gait.csv") if row["number"] == "duty"]
    return sum(value >= max(duty) / 2 for value in duty)


OTHERS: dict[str, Callable[[Path, str], float]] = {
    "args": lambda folder, name: float(json.loads((folder / "args.json").read_text())[name]),
    "core": lambda folder, _: core_seconds(folder),
    "gait": lambda folder, _: feet(folder),
}


def table(suite: Suite, rows: Sequence[Cells]) -> list[Row]:
    """A line for each cell; cells "a at b" share the line of a, where the first column of each one is b."""
    lines, found = dict[str, dict[str, object]](), grouped(rows, "cell")
    for cell in (cell for cell in suite.cells if (cell,) in found):
        values = {title: (how, numbers(found[(cell,)], column)) for title, (how, column) in suite.table.items()}
        shown = {title: SHOW[how](own) if own else "" for title, (how, own) in values.items()}
        name, _, at = cell.partition(" at ")
        lines.setdefault(name, {"case": name}).update({at: next(iter(shown.values()))} if at else shown)
    return [*lines.values()]


def across(suite: Suite, rows: Sequence[Cells]) -> list[Row]:
    """A line for each cell, a column for each group. What has a title is a line of the first cell only."""
    first, titles = next(iter(suite.cells)), [title for title in suite.table if title]
    lines = {name: {"case": name} | dict.fromkeys(suite.groups, "") for name in (*titles, *suite.cells)}
    for (group, cell), own in grouped(rows, "group", "cell").items():
        for title, (how, column) in suite.table.items():
            if cell == first or not title:
                lines[title or cell][group] = SHOW[how](numbers(own, column))
    return [line for line in lines.values() if any([*line.values()][1:])]


def shown(group: str, rows: Sequence[Cells]) -> tuple[str, str]:
    """The name of a group's table, and its text."""
    suite = SUITES[GROUPS[group]]
    if suite.across:
        return GROUPS[group], markdown(across(suite, rows))
    return group, markdown(table(suite, [row for row in rows if row["group"] == group]))


def main(args: Args) -> None:
    check_names("--only", args.only, GROUPS)
    check_names("--cells", args.cells, {cell for suite in SUITES.values() for cell in suite.cells})
    runner = Runner(args)
    for group in args.only:
        suite = SUITES[GROUPS[group]]
        for cell, case in () if args.draw_only else cases(args, group):
            runner.train(case)
            if not args.train_only and (found := line(suite, case.folder)):
                args.keep(suite.csv, {"group": group, "cell": cell, "seed": case.seed} | found, KEY)
        rows = args.read(suite.csv) or read_csv(args.directory.parent / suite.machine / f"{suite.csv}.csv")
        args.publish(*shown(group, rows), "" if group in suite.unshown else suite.page, everywhere=True)


if __name__ == "__main__":
    run(main, Args, __doc__)

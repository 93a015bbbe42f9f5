"""Figures 3, 4, 9 and 10 of the PFPN paper as far as one CPU core gets.

    python benchmarks/pfpn_cells.py                          trains all cells of cases.json; what has finished is kept
    python benchmarks/pfpn_cells.py --only imitation --seeds 1
    python benchmarks/pfpn_cells.py --draw-only --update-results

Writes pfpn_cells.csv (a line for each run: returns, and how many particles were dead and moved), and with
--update-results the tables of docs/pfpn.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, pstdev
from typing import NamedTuple

from cells import Case, Runner, ScriptFlags
from common import check_names, run
from groups import grouped, numbers
from tables import Row, markdown, read_csv


class Figure(NamedTuple):
    """Cells, each the flags by which it differs from the others, that share a task and flags."""

    env: str
    flags: str
    cells: dict[str, str]
    script: str = "pfpn"


CASES = json.loads(Path(__file__).with_name("cases.json").read_text())["pfpn"]
FIGURES = {name: Figure(**case) for name, case in CASES.items()}
KEY = ("figure", "cell", "seed")


@dataclass
class Args(ScriptFlags):
    only: tuple[str, ...] = tuple(FIGURES)  # figures
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds of each cell


def cases(args: Args) -> Iterator[Case]:
    """One seed of all cells after the other, so that cells can be compared early."""
    for name in args.only:
        figure = FIGURES[name]
        for number in args.seeds:
            for cell, flags in figure.cells.items():
                folder = args.runs / "pfpn" / name / f"{cell}__{number}"
                yield Case(folder, figure.env, number, figure.script, (*figure.flags.split(), *flags.split()))


def measured(args: Args) -> Iterator[Row]:
    """A line for each run that has been evaluated, finished or not."""
    for case in cases(args):
        rows = read_csv(case.folder / "progress.csv")
        returns, evaluated = numbers(rows, "return"), numbers(rows, "eval_return")
        if not evaluated:
            continue
        row: dict[str, object] = {"figure": case.folder.parent.name, "cell": case.folder.name.rpartition("__")[0]}
        row |= {"seed": case.seed, "control_steps": rows[-1]["control_steps"], "eval_return": evaluated[-1]}
        row |= {"training": returns[-1], "training_mean": mean(returns)}
        if moved := rows[-1].get("particles_moved"):
            row |= {f"dead_by_{by}": max(numbers(rows, f"particles_dead_{by}")) for by in ("mean", "max")}
            row |= {"moved": int(float(moved)), "active": float(rows[-1]["particles_active"])}
        yield row


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each cell: means over its seeds, of the evaluation their deviation, too; of the dead the most."""
    lines = list[Row]()
    for (cell,), own in grouped(rows, "cell").items():
        returns, moved = numbers(own, "eval_return"), numbers(own, "moved")
        dead = (f"{max(numbers(own, f'dead_by_{by}')):.0%}" for by in ("mean", "max")) if moved else ()
        line = {"case": cell, "return": f"{mean(returns):.0f}" + (f" ± {pstdev(returns):.0f}" if own[1:] else "")}
        line |= {"in training": f"{mean(numbers(own, 'training_mean')):.0f}", "dead": "/".join(dead)}
        lines.append(line | {"moved": f"{mean(moved):.0f}" if moved else ""})
    return lines


def main(args: Args) -> None:
    check_names("--only", args.only, FIGURES)
    if not args.draw_only:
        runner = Runner(args)
        for case in cases(args):
            runner.train(case)
    rows = args.replace("pfpn_cells", list(measured(args)), KEY)
    for name in args.only:
        args.publish(name, markdown(table([row for row in rows if row["figure"] == name])), "pfpn.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

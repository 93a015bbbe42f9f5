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

from common import run
from runner import Case, Runner, ScriptFlags, seed
from tables import Row, markdown, read_csv


class Figure(NamedTuple):
    """Cells, each the flags by which it differs from the others, that share a task and flags."""

    env: str
    flags: str
    cells: dict[str, str]


FIGURES = {
    name: Figure(**case)
    for name, case in json.loads(Path(__file__).with_name("cases.json").read_text())["pfpn"].items()
}
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
                yield Case(folder, figure.env, number, "pfpn", (*figure.flags.split(), *flags.split()))


def measured(args: Args) -> Iterator[Row]:
    """A line for each run that has been evaluated, finished or not."""
    for case in cases(args):
        rows = read_csv(case.folder / "progress.csv")
        returns = [float(row["return"]) for row in rows if row["return"]]
        evaluated = [row["eval_return"] for row in rows if row["eval_return"]]
        if not evaluated:
            continue
        row: dict[str, object] = {"figure": case.folder.parent.name, "cell": case.folder.name.rpartition("__")[0]}
        row |= {"seed": seed(case.folder), "control_steps": rows[-1]["control_steps"]}
        row |= {"eval_return": float(evaluated[-1]), "training": returns[-1], "training_mean": mean(returns)}
        if moved := rows[-1].get("particles_moved"):
            dead = {f"dead_by_{by}": max(float(row[f"particles_dead_{by}"]) for row in rows) for by in ("mean", "max")}
            row |= dead | {"moved": int(float(moved)), "active": float(rows[-1]["particles_active"])}
        yield row


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each cell: means over its seeds, of the evaluation their deviation, too; of the dead the most."""
    found: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        found.setdefault(row["cell"], []).append(row)
    lines = [line(cell, own) for cell, own in found.items()]
    columns = dict.fromkeys(name for row in lines for name in row)
    return [{name: row.get(name, "") for name in columns} for row in lines]


NUMBERS = ("eval_return", "training_mean", "dead_by_mean", "dead_by_max", "moved")


def line(cell: str, rows: list[dict[str, str]]) -> Row:
    numbers = {name: [float(row[name]) for row in rows if row.get(name)] for name in NUMBERS}
    returns = numbers["eval_return"]
    shown: dict[str, object] = {
        "case": cell,
        "return": f"{mean(returns):.0f}" + (f" ± {pstdev(returns):.0f}" if len(returns) > 1 else ""),
        "in training": f"{mean(numbers['training_mean']):.0f}",
    }
    if numbers["moved"]:
        dead = (max(numbers[f"dead_by_{by}"]) for by in ("mean", "max"))
        shown |= {"dead": "/".join(f"{share:.0%}" for share in dead), "moved": f"{mean(numbers['moved']):.0f}"}
    return shown


def main(args: Args) -> None:
    if not args.draw_only:
        runner = Runner(args)
        for case in cases(args):
            runner.train(case)
    rows = args.merge("pfpn_cells", list(measured(args)), KEY)
    for name in args.only:
        args.publish(name, markdown(table([row for row in rows if row["figure"] == name])), "pfpn.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

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
    """A line for each run, finished or not."""
    for case in cases(args):
        rows = read_csv(case.folder / "progress.csv")
        evaluated = [row for row in rows if row.get("eval_return")]
        if not evaluated:
            continue
        last = rows[-1]
        row: dict[str, object] = {
            "figure": case.folder.parent.name,
            "cell": case.folder.name.rpartition("__")[0],
            "seed": seed(case.folder),
            "control steps": int(float(last["control_steps"])),
            "return": float(evaluated[-1]["eval_return"]),
            "best return": max(float(row["eval_return"]) for row in evaluated),
            "return of training": float(last["return"]),
        }
        if moved := last.get("particles_moved"):
            dead = {by: [float(row[f"particles_dead_{by}"]) for row in rows] for by in ("mean", "max")}
            row |= {f"dead by {by} (%)": 100 * max(values) for by, values in dead.items()}
            row |= {"moved": int(float(moved))}
        yield row


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each cell: means over its seeds, and their deviation where there are several."""
    found: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        found.setdefault(row["cell"], []).append(row)
    return [
        {"cell": cell, "seeds": len(own)} | {name: summary(own, name) for name in SHOWN} for cell, own in found.items()
    ]


SHOWN = ("control steps", "return", "best return", "return of training", "dead by mean (%)", "dead by max (%)", "moved")


def summary(rows: list[dict[str, str]], name: str) -> str:
    values = [float(row[name]) for row in rows if row.get(name)]
    if not values:
        return ""
    if name == "control steps":
        return f"{mean(values) / 1e6:.3g} M"
    return f"{mean(values):.0f}" + (f" ± {pstdev(values):.0f}" if len(values) > 1 and "return" in name else "")


def main(args: Args) -> None:
    if not args.draw_only:
        runner = Runner(args)
        for case in cases(args):
            runner.train(case)
    args.merge("pfpn_cells", list(measured(args)), KEY)
    rows = args.read("pfpn_cells")
    for name in args.only:
        args.publish(name, markdown(table([row for row in rows if row["figure"] == name])), "pfpn.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

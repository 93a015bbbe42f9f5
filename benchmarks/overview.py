"""All results on one page, from the csv files that other benchmarks wrote: docs/benchmarks.md, and README's table.

    python benchmarks/overview.py --update-results

A row is a learner on a task and a machine, with all its seeds; new rows of cells.csv and curves.csv join by themselves.
Robots that MuJoCo judges are on pages of their own; here are the curves of their races.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cells
import common
import numpy as np
import paper
from cells import RETURNS, Curve
from common import LEARNT, Line, Panel, plot, run
from tables import Row, grouped, markdown, read_csv

PAGE, README = "benchmarks.md", "../README.md"
GPUS = "h200", "h100"  # of a learner with results on both the first one counts
# Ablations of a learner have their pages. Each learner keeps its colour.
SHOWN = "rpo shac sapo ppo_4096 ppo_baseline bptt sac_baseline sac_large redq redq_500 mbpo se_mbpo".split()
COLUMNS = ("task", "learner", "return", "training (s)", "s to target", "steps to target", "falls")
MAIN = {"rpo": "RPO", "shac": "SHAC", "ppo_4096": "PPO"}  # in the README
RACES = (
    ("joystick_race", "error", "go2", "error (m/s)"),
    ("joystick_race", "error", "g1", "error (m/s)"),
    ("tracking_race", "success", "g1_track", "success"),
)


@dataclass
class Args(common.CommonFlags):
    draw_only: bool = True  # there is nothing to measure


def lines(machine: str) -> dict[tuple[str, str], Row]:
    """By task and learner, in their order: a line of medians where all seeds are of today and of one machine."""
    rows, found = cells.read_cells(common.RESULTS / machine), dict[tuple[str, str], Row]()
    own = grouped((row for row in rows if cells.counts(row, timed=False)), "task", "learner")
    for task, learner in product(LEARNT, SHOWN):
        seeds = own.get((task, learner), [])
        if len(seeds) > 2 and len({row["trained on"] for row in seeds}) == 1:
            total = next((row["in all (s)"] for row in seeds if row["seed"] == "1"), "")
            shown: Row = {**paper.line(seeds), "in all (s)": f"{float(total):.0f}" if total else ""}
            found[task, learner] = {**shown, "training (s)": paper.seconds(shown)}
    return found


def gpu() -> dict[tuple[str, str], Row]:
    """Of the first GPU that has a learner on a task; another's name is in the learner's."""
    found = dict[tuple[str, str], Row]()
    for machine in reversed(GPUS):
        mark = "" if machine == GPUS[0] else f" ({machine})"
        found |= {key: {**row, "learner": f"{row['learner']}{mark}"} for key, row in lines(machine).items()}
    return {key: found[key] for key in product(LEARNT, SHOWN) if key in found}


def compared(found: dict[tuple[str, str], Row]) -> Iterator[Row]:
    """README's table: of each main learner the return, the seconds and the control steps to the target."""
    there = [learner for learner in MAIN if any(key[1] == learner for key in found)]
    for task in LEARNT:
        own = {learner: found[task, learner] for learner in there if (task, learner) in found}
        if len(own) > 1:
            line: dict[str, object] = {"task": task}
            for learner, row in own.items():
                times = row["s to target"], row["steps to target"]
                reached = "not" if "never" in times else f"{times[0]} s, {times[1]}"
                mark = str(row["learner"]).removeprefix(learner).upper()
                line[MAIN[learner] + mark] = f"{float(str(row['return']).split()[0]):,.0f}<br>{reached}"
            yield line


def median_curve(runs: Sequence[Curve], style: str, label: str) -> Line:
    """Against seconds, where all runs have some."""
    begin, end = max(each["seconds"][0] for each in runs), min(each["seconds"][-1] for each in runs)
    shared = np.geomspace(begin, end, 300)
    returns = [np.interp(shared, each["seconds"], each["return"]) for each in runs]
    return Line(shared, np.median(returns, axis=0), style, label)


def panels(machines: Sequence[str]) -> list[Panel]:
    """One for each task: a line for each learner that has its seconds."""
    drawn = dict[tuple[str, str], Line]()
    for machine in machines:
        known = cells.paces(common.RESULTS / machine)
        rows = [row for row in read_csv(common.RESULTS / machine / "curves.csv") if row["learner"] in SHOWN]
        for (learner, task), own in grouped(rows, "learner", "task").items():
            if (learner, task) in drawn or task not in RETURNS:
                continue
            for row in own:
                if not row["seconds"] and (pace := known.get((learner, task))):
                    row["seconds"] = str(pace(float(row["iteration"])))
            runs = [cells.curve(seed) for seed in grouped(own, "seed").values()]
            if len(runs) > 2 and not any(np.isnan(each["seconds"]).any() for each in runs):
                colour = SHOWN.index(learner) % 10
                drawn[learner, task] = median_curve(
                    runs, f"C{colour}{'-' if SHOWN.index(learner) < 10 else '--'}", learner
                )
    tasks = [task for task in LEARNT if any(key[1] == task for key in drawn)]
    return [
        Panel([line for (_, each), line in drawn.items() if each == task], task, "seconds of training", "return", "x")
        for task in tasks
    ]


def races() -> Iterator[Panel]:
    """What MuJoCo says of checkpoints along trainings: each seed."""
    for file, column, task, y in RACES:
        rows, drawn = read_csv(common.RESULTS / "cpu" / f"{file}.csv"), list[Line]()
        rows = [row for row in rows if row["task"] == task and "_shared/" not in row["checkpoint"]]
        for (learner, _), own in grouped(rows, "learner", "seed").items():
            own.sort(key=lambda row: float(row["training s"]))
            script = "ppo_4096" if learner.startswith("ppo") else learner.partition(" ")[0]
            x, values = ([float(row[name]) for row in own] for name in ("training s", column))
            drawn.append(Line(x, values, f"C{SHOWN.index(script)}-", script, 1.0))
        yield Panel(drawn, task, "seconds of training", y, "xy" if column == "error" else "x")


def main(args: Args) -> None:
    on_gpu = gpu()
    args.publish("why", markdown([*compared(on_gpu)]), README)
    args.publish("gpu", markdown([*on_gpu.values()], COLUMNS), PAGE)
    args.publish("cpu", markdown([*lines("cpu").values()], COLUMNS), PAGE)
    grid = [*panels(GPUS), *races()]
    plot(args.picture("benchmarks"), [grid], (3.4, 2.6))
    plot(args.picture("benchmarks_cpu"), [panels(("cpu",))], (3.4, 2.6))


if __name__ == "__main__":
    run(main, Args, __doc__)

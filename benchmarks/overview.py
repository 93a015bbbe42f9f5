"""All results on one page, from the csv files that other benchmarks wrote: docs/benchmarks.md, and README's table.

    python benchmarks/overview.py --update-results

A row is a learner on a task and a machine, with all its seeds; new rows of cells.csv and curves.csv join by themselves.
Robots that MuJoCo judges are on pages of their own; here are the curves of their races.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import median

import cells
import common
import numpy as np
import paper
from cells import RETURNS, Curve
from common import COLOURS, LEARNT, NAMES, Line, Panel, plot, run
from tables import Row, grouped, markdown, numbers, ranged, read_csv

PAGE, README = "benchmarks.md", "../README.md"
GPUS = "h200", "h100"  # of a learner with results on both the first one counts
# Ablations of a learner have their pages.
SHOWN = "rpo shac sapo ppo_4096 ppo_baseline bptt sac_baseline sac_large redq redq_500 mbpo se_mbpo".split()
SAME_STEPS = {"ant": ("rpo", "shac_8", "ppo_8"), "humanoid": ("rpo", "ppo_16")}  # in the README: groups steps_...
TUNED = "entropy bonus 0.01"  # of PPO's trials: the default of these tasks
RACES = (
    ("joystick_race", "error", "go2", "velocity error (m/s)"),
    ("joystick_race", "error", "g1", "velocity error (m/s)"),
    ("tracking_race", "success", "g1_track", "share of successes"),
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
            shown: Row = {**paper.line(seeds), "seed 1 in all (s)": f"{float(total):.0f}" if total else ""}
            name = (
                f"{NAMES[learner]}{cpu(seeds[0]['trained on']) if machine == 'cpu' and shown['training (s)'] else ''}"
            )
            found[task, learner] = {**shown, "learner": name}
    return found


def cpu(trained_on: str) -> str:
    """Name the CPU in brackets: "2 of 16 cores of Intel(R) Xeon(R) Processor" is (Xeon, 2 of 16)."""
    share, _, kind = trained_on.partition(" cores of ")
    return f" ({'EPYC' if 'EPYC' in kind else 'Xeon'}{f', {share}' if 'of' in share else ''})"


def gpu() -> list[Row]:
    """Rows of the first GPU that has a learner on a task; another's name is in the learner's. PPO's tuned rows last."""
    found = dict[tuple[str, str], Row]()
    for machine in reversed(GPUS):
        mark = "" if machine == GPUS[0] else f" ({machine})"
        found |= {key: {**row, "learner": f"{row['learner']}{mark}"} for key, row in lines(machine).items()}
    rows = list[Row]()
    for task in LEARNT:
        rows += [found[task, learner] for learner in SHOWN if (task, learner) in found]
        rows += [{"task": task, "learner": "PPO, tuned", "return": tuned}] if (tuned := returns_of_tuned(task)) else []
    return rows


def returns_of_tuned(task: str, form: str = ".0f") -> str:
    """Those of PPO's trials with the entropy bonus that became a task's default."""
    rows = read_csv(common.RESULTS / "h100" / "ppo_trials.csv")
    rows = [row for row in rows if (row["group"], row["cell"]) == (f"{task}, 157 M", TUNED)]
    return ranged(numbers(rows, "return"), form)


def compared() -> Iterator[Row]:
    """README's table, of one H200: learners with the same steps of the simulation, over seeds."""
    rows = [row for row in cells.read_cells(common.RESULTS / GPUS[0]) if cells.counts(row, timed=True)]
    for task, learners in SAME_STEPS.items():
        target = RETURNS[task].target
        for learner in learners:
            own = [row for row in rows if (row["learner"], row["task"]) == (learner, task)]
            steps = median(numbers(own, f"control_steps to {target}")) / 1e6
            yield {
                "task": task,
                "learner": {"rpo": "RPO (our variant)"}.get(learner, learner.partition("_")[0].upper()),
                "final return": ranged(numbers(own, "return"), ",.0f"),
                f"M steps to {target:,}": f"{steps:.2g}",
                f"s to {target:,}": ranged(numbers(own, f"seconds to {target}"), ".0f"),
                "whole training (s)": ranged(numbers(own, "training (s)"), ".0f"),
                "from the command (s)": ranged(numbers(own, "in all (s)"), ".0f"),
            }
        if tuned := returns_of_tuned(task, ",.0f"):
            yield {"task": task, "learner": "PPO, tuned", "final return": tuned}


def curves_of(learner: str, runs: Sequence[Curve]) -> list[Line]:
    """Draw each seed from its own start (thin), and the median."""
    style = f"{COLOURS[learner]}-"
    end = max(float(each["seconds"][-1]) for each in runs)
    seeds = [Line(each["seconds"], each["return"], style, width=0.4) for each in runs]
    return [*seeds, Line(*paper.median_curve(runs, "seconds", end), style, NAMES[learner], 1.8)]


def panels(machines: Sequence[str]) -> list[Panel]:
    """One for each task: a line for each learner that has its seconds."""
    drawn = dict[tuple[str, str], list[Line]]()
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
                drawn[learner, task] = curves_of(learner, runs)
    tasks = [task for task in LEARNT if any(key[1] == task for key in drawn)]
    y = "return of training episodes"
    found = {task: [line for (_, each), own in drawn.items() if each == task for line in own] for task in tasks}
    return [Panel(own, task, "seconds of training", y, "x") for task, own in found.items()]


def races() -> Iterator[Panel]:
    """What MuJoCo says of checkpoints along trainings: each seed."""
    for file, column, task, y in RACES:
        rows, drawn = read_csv(common.RESULTS / "cpu" / f"{file}.csv"), list[Line]()
        rows = [row for row in rows if row["task"] == task and "_shared/" not in row["checkpoint"]]
        for (learner, _), own in grouped(rows, "learner", "seed").items():
            own.sort(key=lambda row: float(row["training s"]))
            script = "ppo_4096" if learner.startswith("ppo") else learner.partition(" ")[0]
            x, values = ([float(row[name]) for row in own] for name in ("training s", column))
            drawn.append(Line(x, values, f"{COLOURS[script]}-", NAMES[script], 1.0))
        yield Panel(drawn, task, "seconds of training", y, "xy" if column == "error" else "x")


def main(args: Args) -> None:
    args.publish("why", markdown([*compared()]), README)
    args.publish("gpu", paper.by_task(gpu()), PAGE)
    args.publish("cpu", paper.by_task([*lines("cpu").values()]), PAGE)
    grid = [*panels(GPUS), *races()]
    plot(args.picture("benchmarks"), [grid], (3.4, 2.6))
    plot(args.picture("benchmarks_cpu"), [panels(("cpu",))], (3.4, 2.6))


if __name__ == "__main__":
    run(main, Args, __doc__)

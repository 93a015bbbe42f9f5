"""What accuracy costs in learning, and what it buys: seconds of training, and the return that holds.

    python benchmarks/trade.py                                         all trainings; what has finished is kept
    python benchmarks/trade.py --env ant --parts accuracy --seeds 1
    python benchmarks/trade.py --draw-only --update-results            only the figure and the tables

A return holds if the same policy has it at four times the substeps, or in MuJoCo on the same file. Seconds are CPU time
of a training on one thread, which does not depend on what else the machine does; evaluations are not in it. A training
that fails is a row with its message. Kernels are compiled before: a training of the same flags has run already.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Literal, NamedTuple

from cells import Case, Runner, ScriptFlags, evaluation
from common import LEARNT, Line, Panel, Tasks, load_case, plot, run
from suites import core_seconds
from tables import Cells, Row, grouped, markdown, middle, numbers, read_csv
from transfer import in_mujoco

PartName = Literal["accuracy", "contact", "substeps", "horizon"]
ONCE = "--threads 1 --eval-every 0 --save-every 0 --eval-episodes 1"  # of all trainings
EPISODES = 64  # on which a policy is judged
KEY = ("part", "task", "setting", "seed")
PAGE = "numerics.md"


class Part(NamedTuple):
    tasks: dict[str, str]  # and their scripts, one or more
    settings: dict[str, str]  # flags by the settings' names


HORIZONS = {h: f"--horizon {h} --num-envs {2048 // h} --iterations 200" for h in (1, 8, 32, 128, 256)}  # equal samples
PARTS: dict[PartName, Part] = {
    "accuracy": Part(
        {"cartpole": "rpo shac", "half_cheetah": "rpo shac", "hopper": "rpo", "ant": "rpo"},
        {"default": "", "fast": "--accuracy fast", "accurate": "--accuracy accurate"},
    ),
    "contact": Part(
        {"half_cheetah": "rpo", "hopper": "rpo", "ant": "rpo"},
        {
            "preset": "--contact mujoco",
            "no onset": "--contact mujoco --onset 0 0 --mix 0 --horizon 8 --adjoint-clip 0 --num-envs 256",
        },
    ),
    "substeps": Part({"half_cheetah": "rpo", "hopper": "rpo"}, {str(n): f"--substeps {n}" for n in (8, 4, 2, 1)}),
    "horizon": Part(
        {"cartpole": "rpo", "half_cheetah": "rpo"},
        {str(h): flags for h, flags in HORIZONS.items()}
        | {f"{h}, clipped": f"{flags} --adjoint-clip 5" for h, flags in HORIZONS.items()},
    ),
}


@dataclass
class Args(ScriptFlags):
    env: Tasks = ("cartpole", "half_cheetah", "hopper", "ant")
    device: str = "cpu"  # torch device of the runs
    runs: Path = ScriptFlags.runs.parent / "trade"  # directory of the runs
    parts: tuple[PartName, ...] = ("accuracy", "contact", "substeps", "horizon")  # questions
    settings: tuple[str, ...] = ()  # of a part, such as fast (default: all)
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds, each of all before the next one


def cases(args: Args) -> Iterator[tuple[dict[str, object], Case]]:
    """What a row of the csv file is of, and its training."""
    for seed, part, task in product(args.seeds, args.parts, args.env):
        scripts, settings = PARTS[part].tasks.get(task, "").split(), PARTS[part].settings
        for setting, script in product([name for name in settings if name in (args.settings or settings)], scripts):
            name = setting if script == "rpo" else f"{script}, {setting}"
            folder = args.runs / part / re.sub(r"\W+", "_", f"{task}__{name}") / str(seed)
            about = {"part": part, "task": task, "setting": name, "seed": seed}
            yield about, Case(folder, task, seed, script, (*ONCE.split(), *settings[setting].split()))


def measure(runner: Runner, case: Case) -> dict[str, object]:
    """Train and judge; of a training that failed, what it printed last. Empty if the time was up."""
    output = case.folder / "output.txt"
    if not runner.train(case):
        said = output.read_text().splitlines() if output.is_file() else []
        return {"failed": said[-1]} if said and "stopped early" not in said[-1] else {}
    if not runner.evaluate(case, "judged", "--eval-episodes", EPISODES):
        return {}
    found, progress = evaluation(case.folder / "judged"), read_csv(case.folder / "progress.csv")
    there = in_mujoco(load_case(case.folder, EPISODES, "cpu"))
    return {
        "substeps": found["settings"]["substeps"],
        "control steps": int(progress[-1]["control_steps"]),
        "core seconds": core_seconds(case.folder) if runner.args.place == "cpu" else "",
        "return": found["return"],
        "return, finer": found["finer"]["return"],
        "return in MuJoCo": there.get("return", ""),
        "whole in MuJoCo": there.get("whole", ""),
        "norm of gradient": median(numbers(progress, "grad_norm")),
        "contained": sum(numbers(progress, "sim_nonfinite") + numbers(progress, "sim_nonfinite_gradients")),
        "failed": "",
    }


def retained(rows: list[Cells]) -> list[Row]:
    """A line for each setting of a part, medians of its seeds. Those of the front are bold: no other one of the task is
    both faster and better in the return that holds."""
    lines = list[Row]()
    for (task,), own in grouped(rows, "task").items():
        settings = {name: each for (name,), each in grouped(own, "setting").items()}
        points = {name: (cost(each), holds(each)) for name, each in settings.items() if numbers(each, "return, finer")}
        for name, each in settings.items():
            here = points.get(name)
            best = here and not any(x < here[0] and y >= here[1] for x, y in points.values())
            line = {"task": task, "setting": f"**{name}**" if best else name}
            line |= {"core seconds": middle(each, "core seconds", ".0f"), "return": middle(each, "return", ".0f")}
            line |= {"return, finer": middle(each, "return, finer", ".0f")}
            line |= {"in MuJoCo": middle(each, "return in MuJoCo", ".0f")}
            lines.append(line | {"without a fall there": middle(each, "whole in MuJoCo", ".0%")})
    return lines


def cost(rows: list[Cells]) -> float:
    return median(numbers(rows, "core seconds"))


def holds(rows: list[Cells]) -> float:
    return median(numbers(rows, "return, finer"))


def told(rows: list[Cells]) -> list[Row]:
    """A line for each setting of an extreme: its returns, what was contained, and what a failure printed."""
    lines = list[Row]()
    for row in rows:
        line = {"task": row["task"], row["part"]: row["setting"]}
        line |= {name: middle([row], name, ".0f") for name in ("core seconds", "return", "return, finer", "contained")}
        lines.append(line | {"failed": row["failed"]})
    return lines


def panels(rows: list[Cells]) -> Iterator[Panel]:
    """Seconds against the return that holds, of each task: medians as points, all seeds as a line."""
    styles = {name: f"C{k}" for k, name in enumerate(dict.fromkeys(row["setting"].split(", ")[-1] for row in rows))}
    for (task,), own in grouped(rows, "task").items():
        lines = list[Line]()
        for (name,), each in grouped([row for row in own if row["return, finer"]], "setting").items():
            x, y, style = cost(each), numbers(each, "return, finer"), styles[name.split(", ")[-1]]
            marker = "s" if name.startswith("shac") else "o"
            lines += [Line([x, x], [min(y), max(y)], f"{style}-"), Line([x], [holds(each)], f"{style}{marker}", name)]
        yield Panel(lines, task, "core seconds of training", "return at 4 x the substeps", "x")


def main(args: Args) -> None:
    runner = Runner(args)
    for about, case in () if args.draw_only else cases(args):
        if all(any(str(about[name]) != row[name] for name in KEY) for row in args.read("trade")):
            if found := measure(runner, case):
                args.keep("trade", about | found, KEY)
    rows = sorted(args.read("trade"), key=lambda row: LEARNT.index(row["task"]))
    for part in PARTS:
        own = [row for row in rows if row["part"] == part]
        shown = retained(own) if part in ("accuracy", "contact") else told(own)
        args.publish(f"trade {part}", markdown(shown), PAGE)
    plot(args.picture("trade"), [[*panels([row for row in rows if row["part"] == "accuracy"])]], (3.2, 2.8))


if __name__ == "__main__":
    run(main, Args, __doc__)

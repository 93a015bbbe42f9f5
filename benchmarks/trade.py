"""What accuracy costs in learning, and what it buys: seconds of training, and the return that holds.

    python benchmarks/trade.py                                         all trainings; what has finished is kept
    python benchmarks/trade.py --env ant --parts accuracy --seeds 1
    python benchmarks/trade.py --time-limit 0                          judge what has been trained
    python benchmarks/trade.py --draw-only --update-results            only the figure and the tables

A return holds if the same policy has it at four times the substeps, or in MuJoCo on the same file. Seconds are CPU time
of a training on one thread, which does not depend on what else the machine does; evaluations are not in it. A training
that fails is a row with its message. Kernels are compiled before: a training of the same flags has run already.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Literal, NamedTuple, get_args

from cells import Case, Runner, ScriptFlags, evaluation
from common import LEARNT, RESULTS, Line, Panel, Tasks, load_case, plot, run
from numerics import named
from suites import core_seconds
from tables import Cells, Row, grouped, markdown, middle, numbers, read_csv
from transfer import in_mujoco

import rpo
from diffsim.sim.integration import Integration
from diffsim.tasks import FILE, find_task
from diffsim.training.evaluation import kept

PartName = Literal["accuracy", "contact", "substeps", "horizon", "scene"]
ONCE = "--threads 1 --eval-every 0 --save-every 0 --eval-episodes 1"  # of all trainings
EPISODES = 64  # on which a policy is judged
KEY = ("part", "task", "setting", "seed")
PAGE = "numerics.md"
FASTER, AS_HIGH = 0.8, 0.99  # shares of the seconds and of the return: what beats a setting


class Part(NamedTuple):
    tasks: dict[str, str]  # and their scripts, one or more
    settings: dict[str, str]  # flags by the settings' names


HORIZONS = {h: f"--horizon {h} --num-envs {2048 // h} --iterations 200" for h in (1, 8, 32, 128, 256)}  # equal samples
PARTS: dict[PartName, Part] = {
    "accuracy": Part(
        {"cartpole": "rpo shac", "half_cheetah": "rpo shac", "hopper": "rpo", "ant": "rpo", "humanoid": "rpo"},
        {"fast": "--accuracy fast", "default": "", "accurate": "--accuracy accurate"},
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
    "scene": Part(
        {"half_cheetah": "rpo"},
        {"without limits": "--env benchmarks/scenes.py:Unlimited", "with drag": "--env benchmarks/scenes.py:Dragged"},
    ),
}

# Columns of the tables: their titles, those of the csv files and their form.
TRADED = {"core seconds": ("core seconds", ".0f"), "return": ("return", ".0f")}
TRADED |= {"at 4 x the substeps": ("return, finer", ".0f"), "in MuJoCo": ("return in MuJoCo", ".0f")}
TRADED |= {"without a fall there": ("whole in MuJoCo", ".0%")}
EXTREME = {"core seconds": "core seconds", "return": "return", "at 4 x the substeps": "return, finer"}
EXTREME |= {"updates skipped": "skipped", "contained": "contained"}
SHARE = "share of the best return"
ERRORS = {"state error (m, rad)": "state 0.5 s", "gradient error": "gradient 32", "cosine": "cosine 32"}


@dataclass
class Args(ScriptFlags):
    env: Tasks = ("cartpole", "half_cheetah", "hopper", "ant")
    device: str = "cpu"  # torch device of the runs
    runs: Path = ScriptFlags.runs.parent / "trade"  # directory of the runs
    parts: tuple[PartName, ...] = get_args(PartName)  # questions
    settings: tuple[str, ...] = ()  # of a part, such as fast (default: all)
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds, each of all before the next one


def cases(args: Args) -> Iterator[tuple[dict[str, object], Case]]:
    """What a row of the csv file is of, and its training."""
    for seed, part, task in product(args.seeds, args.parts, args.env):
        scripts, settings = PARTS[part].tasks.get(task, "").split(), PARTS[part].settings
        for script, setting in product(scripts, settings):
            name = setting if script == "rpo" else f"{script}, {setting}"
            if name in (args.settings or (name,)):
                folder = args.runs / part / re.sub(r"\W+", "_", f"{task}__{name}") / str(seed)
                about = {"part": part, "task": task, "setting": name, "seed": seed}
                flags = settings[setting].split()
                env, flags = (flags[1], flags[2:]) if flags[:1] == ["--env"] else (task, flags)
                yield about, Case(folder, env, seed, script, (*ONCE.split(), *flags))


def measure(runner: Runner, case: Case) -> dict[str, object]:
    """Train and judge; of a training that failed, what it printed last. Empty if the time was up."""
    output = case.folder / "output.txt"
    if not runner.train(case):
        said = output.read_text().splitlines() if output.is_file() else []
        return {"failed": said[-1]} if said and "stopped early" not in said[-1] else {}
    if not runner.evaluate(case, "judged", "--env", case.env, "--eval-episodes", EPISODES):
        return {}
    found, progress = evaluation(case.folder / "judged"), read_csv(case.folder / "progress.csv")
    there = {} if FILE.fullmatch(case.env) else in_mujoco(load_case(case.folder, EPISODES, "cpu"))
    return {
        "substeps": found["settings"]["substeps"],
        "control steps": int(progress[-1]["control_steps"]),
        "core seconds": core_seconds(case.folder) if runner.args.place == "cpu" else "",
        "return": found["return"],
        "return, finer": found["finer"]["return"],
        "return in MuJoCo": there.get("return", ""),
        "whole in MuJoCo": there.get("whole", ""),
        "norm of gradient": median(numbers(progress, "grad_norm")),
        "skipped": numbers(progress, "grad_skipped")[-1],
        "contained": sum(numbers(progress, f"sim_{name}")[-1] for name in ("nonfinite", "nonfinite_gradients")),
        "failed": "",
    }


def defaults(directory: Path, tasks: Sequence[str]) -> list[Cells]:
    """RPO's trainings at the default on a GPU, of cells.csv."""
    rows = [row for row in read_csv(directory / "cells.csv") if row["learner"] == "rpo" and row["task"] in tasks]
    rows = [row for row in rows if row["kept"]]  # empty of a cost that became a gain
    for row in rows:
        own, kept = float(row["return"]), float(row["kept"])
        row |= {"part": "accuracy", "setting": "default", "return, finer": str(own * kept if own > 0 else own / kept)}
    return rows


# Tables and the figure ------------------------------------------------------------------------------------------------


def seconds(rows: list[Cells]) -> float:
    return median(numbers(rows, "core seconds") or [math.nan])


def holds(rows: list[Cells]) -> float:
    return median(numbers(rows, "return, finer"))


def front(points: Mapping[str, tuple[float, float]]) -> set[str]:
    """Those seconds and returns that no others beat: by a fifth of the seconds, with a return as high to 1 %."""

    def beaten(x: float, y: float) -> bool:
        return any(a < FASTER * x and kept(y, b) >= AS_HIGH for a, b in points.values())

    return {name for name, point in points.items() if not beaten(*point)}


def traded(rows: list[Cells]) -> list[Row]:
    """A line for each task and setting, medians of its seeds; settings of the front are bold."""
    lines = list[Row]()
    for (task,), own in grouped(rows, "task").items():
        settings = {name: each for (name,), each in grouped(own, "setting").items()}
        ended = {name: each for name, each in settings.items() if numbers(each, "return, finer")}
        best = front({name: (seconds(each), holds(each)) for name, each in ended.items()})
        for name, each in settings.items():
            line = {"task": task, "setting": f"**{name}**" if name in best and seconds(each) > 0 else name}
            for title, (column, form) in TRADED.items():
                line |= {title: middle(each, column, form)} if numbers(rows, column) else {}
            lines.append(line)
    return lines


def extreme(rows: list[Cells]) -> list[Row]:
    """A line for each training: its returns, updates that were skipped, states and gradients that were contained, and
    the message of one that failed."""
    lines = list[Row]()
    for row in rows:
        line = {"task": row["task"], row["part"]: row["setting"]}
        line |= {title: middle([row], column, ".0f") for title, column in EXTREME.items()}
        lines.append(line | ({"failed": row["failed"]} if any(each["failed"] for each in rows) else {}))
    return lines


def integration(row: Cells) -> Integration:
    """How RPO's training of a row on penalty contact was integrated."""
    presets = find_task(row["task"]).presets()
    if row["part"] == "substeps":
        return presets["default"]._replace(substeps=int(row["setting"]))
    return (row["setting"] == "default" and rpo.INTEGRATION.get(row["task"])) or presets[row["setting"]]


def learned(rows: list[Cells]) -> list[Cells]:
    """A line for each task and way of integration: its errors, and the return of RPO that holds."""
    errors = {(row["task"], row["setting"]): row for row in read_csv(RESULTS / "cpu" / "numerics_presets.csv")}
    rows = [row for row in rows if row["part"] in ("accuracy", "substeps") and "shac" not in row["setting"]]
    lines = list[Cells]()
    for (task,), own in grouped((row for row in rows if row["return, finer"]), "task").items():
        found = {integration(each[0]): each for each in grouped(own, "part", "setting").values()}
        found = {how: each for how, each in found.items() if (task, named(how)) in errors}
        best = max(map(holds, found.values()))
        for how, each in sorted(found.items(), key=lambda item: item[0].substeps):
            error = errors[task, named(how)]
            line = {"task": task, "substeps": f"{how.substeps}{' implicit' * how.implicit}"}
            line |= {"core seconds": middle(each, "core seconds", ".0f")}
            line |= {title: error[column] for title, column in ERRORS.items()}
            lines.append(line | {SHARE: f"{kept(best, holds(each)):.2f}"})
    return lines


def panels(rows: list[Cells]) -> Iterator[Panel]:
    """Seconds against the share of the best return that holds, of each task: medians as points, all seeds as a line."""
    styles = {name: f"C{k}" for k, name in enumerate(PARTS["accuracy"].settings)}
    for (task,), own in grouped(rows, "task").items():
        lines, points = list[Line](), dict[str, tuple[float, float]]()
        settings = grouped(own, "part", "setting")
        best = max(map(holds, settings.values()))
        for (part, name), each in settings.items():
            learner, _, setting = name.rpartition(", ")
            style = f"{styles.get(setting, 'k')}{'s' if learner else 'o' if part == 'accuracy' else 'x'}"
            label = f"{learner or 'rpo'}, {setting if part == 'accuracy' else 'fewer substeps'}"
            shares = [kept(best, value) for value in numbers(each, "return, finer")]
            point = seconds(each), kept(best, holds(each))
            points |= {name: point} if part == "accuracy" else {}
            lines.append(Line([point[0]] * 2, [min(shares), max(shares)], f"{style[:-1]}-"))
            lines.append(Line([point[0]], [point[1]], style, label))
        through = sorted(points[name] for name in front(points))
        lines.append(Line([x for x, _ in through], [y for _, y in through], "k:", "front", 0.8))
        lines.append(Line([0, max(line.x[0] for line in lines)], [0, 0], "k-", width=0.5))
        yield Panel(lines, task, "core seconds of training", SHARE)


def gradient_panel(rows: list[Cells]) -> Panel:
    """The error of the gradient against the return that holds, a line for each task."""
    lines = list[Line]()
    for k, ((task,), own) in enumerate(grouped(learned(rows), "task").items()):
        x, y = numbers(own, "gradient error"), numbers(own, SHARE)
        lines.append(Line(x, y, f"C{k + 3}o-", task, 0.8))
    return Panel(lines, "all tasks", "error of the gradient over 32 steps", SHARE, "x")


def place(row: Cells) -> tuple[int, bool, int]:
    """Order rows by task, learner and setting."""
    setting, known = row["setting"].removeprefix("shac, "), {str(part): [*PARTS[part].settings] for part in PARTS}
    return LEARNT.index(row["task"]), setting != row["setting"], known[row["part"]].index(setting)


def main(args: Args) -> None:
    runner = Runner(args)
    for about, case in () if args.draw_only else cases(args):
        if all(any(str(about[name]) != row[name] for name in KEY) for row in args.read("trade")):
            if found := measure(runner, case):
                args.keep("trade", about | found, KEY)
    rows = args.read("trade")
    rows += defaults(args.directory, [row["task"] for row in rows]) if args.directory.name != "cpu" else []
    rows.sort(key=place)
    for part in PARTS:
        if own := [row for row in rows if row["part"] == part]:
            shown = traded(own) if part in ("accuracy", "contact") else extreme(own)
            args.publish(f"trade {part}", markdown(shown), PAGE)
    if args.directory.name == "cpu":
        args.publish("trade gradients", markdown(learned(rows)), PAGE)
        drawn = [row for row in rows if row["part"] in ("accuracy", "substeps") and row["return, finer"]]
        plot(args.picture("trade"), [[*panels(drawn), gradient_panel(rows)]], (3.2, 2.8))


if __name__ == "__main__":
    run(main, Args, __doc__)

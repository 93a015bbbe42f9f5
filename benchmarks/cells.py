"""Trainings by the scripts, each in a folder of its own: what was interrupted goes on, what has finished is kept.

A cell is a machine, a learner (a script with flags), a task and a seed; it becomes a row of cells.csv. Learners,
groups of cells and the returns to compare are in cases.json.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, pstdev
from typing import Any, NamedTuple

import common
import fingerprints
import numpy as np
import tables
from tables import ROOT, Cells, read_csv

from diffsim.training import checkpoint, fail

COLUMNS = ("iteration", "control_steps", "seconds", "return")  # of progress.csv, which a curve has
Curve = dict[str, np.ndarray]


class Returns(NamedTuple):
    """A task's returns; those published are of Georgiev et al. 2024, "Adaptive Horizon Actor-Critic", 10 seeds."""

    target: int  # to which learners are compared
    timed: Sequence[int] = ()  # those whose passing is timed
    published: Mapping[str, int] = {}  # by learner: SHAC's and PPO's; drawn


CASES = json.loads(Path(__file__).with_name("cases.json").read_text())
RETURNS = {name: Returns(**case) for name, case in CASES["returns"].items()}
LEARNERS: dict[str, str] = CASES["learners"]  # script and flags


class Group(NamedTuple):
    machine: str  # the folder of results/ and runs/paper/; another GPU is as good as the one that is named
    learners: Sequence[str]
    tasks: Sequence[str]
    seeds: int
    page: str = ""  # of docs/, which has the group's table
    timed: bool = True  # or its cells may share their machine, and have no seconds
    picture: bool = False  # of the curves, under the group's name
    ratios: bool = False  # the table has these of its two learners' best returns
    older: bool = False  # its results are in the csv files that the page names, measured before there were cells


GROUPS = {name: Group(**case) for name, case in CASES["paper"]["groups"].items()}


STOPPING = """
import runpy, sys
from diffsim.training import Run
Run.stop_after = int(sys.argv[1])
del sys.argv[:2]
runpy.run_path(sys.argv[0], run_name="__main__")
"""  # a script, to an iteration


@dataclass
class ScriptFlags(common.CommonFlags):
    device: str = "auto"  # torch device of the learners (auto: the GPU if there is one)
    time_limit: float | None = None  # seconds after which runs in progress stop and save; the next call goes on
    runs: Path = ROOT / "runs" / "learning"  # directory of the runs


class Case(NamedTuple):
    folder: Path
    env: str
    seed: int
    script: str  # "shac@2": two processes of torchrun
    flags: tuple[str, ...] = ()


class Runner:
    def __init__(self, args: ScriptFlags) -> None:
        self.args = args
        self.stop_at = math.inf if args.time_limit is None else time.monotonic() + args.time_limit

    def train(self, case: Case, until: int = 0) -> bool:
        """Train from where it stands to an iteration, 0: the last; whether it got there."""
        start: list[object] = ["--env", case.env, "--seed", case.seed, "--run-dir", case.folder, "--quiet", *case.flags]
        if (path := case.folder / "checkpoint.pt").is_file():
            state = checkpoint.load(path)
            if state["iteration"] >= (until or state["args"]["iterations"]):
                return True
            start = ["--resume", path]
        return self._call(case, *start, *self.args.arguments, until=until)

    def evaluate(self, case: Case, into: str = "", *flags: object) -> bool:
        """Evaluate the checkpoint, with finer steps as well, if that is not done; whether it is now.

        Into a folder of the case's own, its seconds are not the training's.
        """
        iteration = checkpoint.load(path := case.folder / "checkpoint.pt")["iteration"]
        case = case._replace(folder=case.folder / into)
        done = "finer" in evaluation(case.folder, iteration)
        return done or self._call(case, "--evaluate", path, "--run-dir", case.folder, *flags)

    def _call(self, case: Case, *arguments: object, until: int = 0) -> bool:
        """Whether the script came to its end. It is stopped, and saves, when the time is up."""
        left = self.stop_at - time.monotonic()
        if left <= 0:
            return False
        script, _, ranks = case.script.partition("@")
        torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}", "--"] if ranks else []
        stopping = ["-c", STOPPING, str(until)] if until else []
        command = [sys.executable, *torchrun, *stopping, str(tables.script_of(script)), *map(str, arguments)]
        command += ["--device", self.args.device]
        case.folder.mkdir(parents=True, exist_ok=True)
        before = os.times()
        with (case.folder / "output.txt").open("a") as output:
            process = subprocess.Popen(command, stdout=output, stderr=output)
            try:
                process.wait(None if left == math.inf else left)
            except subprocess.TimeoutExpired:
                process.terminate()
                process.wait()
        after = os.times()
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        with (case.folder / "core_seconds.txt").open("a") as file:
            file.write(f"{spent:.1f}\n")
        if process.returncode:
            print(f"{case.folder}: stopped or failed, see output.txt there", flush=True)
        return process.returncode == 0


class Cell(NamedTuple):
    machine: str
    learner: str
    task: str
    seed: int

    def case(self, runs: Path) -> Case:
        folder = runs / self.machine / self.learner / f"{self.task}__{self.seed}"
        script, *flags = LEARNERS[self.learner].split()
        return Case(folder, self.task, self.seed, script, (*flags,))

    @property
    def groups(self) -> list[Group]:
        every = (group for group in GROUPS.values() if (group.machine == "cpu") == (self.machine == "cpu"))
        every = (group for group in every if self.seed <= group.seeds)
        return [group for group in every if self.learner in group.learners and self.task in group.tasks]

    @property
    def timed(self) -> bool:
        return any(group.timed for group in self.groups)

    @property
    def command(self) -> str:
        _, task, seed, script, flags = self.case(Path())
        path, device = tables.script_of(script).relative_to(ROOT), "cpu" if self.machine == "cpu" else "cuda"
        return " ".join((f"python {path} --env {task} --seed {seed} --device {device}", *flags))


def begin(runner: Runner, cell: Cell, case: Case) -> dict[str, object]:
    """What cell.json says of a training, new or begun. A revision that is not recorded is refused."""
    path, revision = case.folder / "cell.json", tables.revision()
    if tables.unknown(f"; ; {revision}"):
        fail(f"a cell is of a commit, not of {revision}")
    if unrecorded := fingerprints.open_end():
        fail(unrecorded)
    begun = json.loads(path.read_text()) if path.is_file() else {}
    if begun and not same_numbers(begun["revision"], cell.learner, cell.task):
        fail(f"{case.folder} was begun at {begun['revision']}: remove it")
    if not begun:
        case.folder.mkdir(parents=True, exist_ok=True)
        trained_on = tables.origin(runner.args.device).removeprefix("# ").partition("; ")[0]
        path.write_text(json.dumps(begun := {"revision": revision, "trained on": trained_on}))
    return begun


def train(runner: Runner, cell: Cell) -> bool:
    """To the end; whether it got there."""
    case = cell.case(runner.args.runs)
    begun = begin(runner, cell, case)
    fresh, start = not (case.folder / "progress.csv").is_file(), time.monotonic()
    if not runner.train(case):
        return False
    if fresh and "--eval-every" not in runner.args.arguments:  # trained in one go, with all evaluations
        (case.folder / "cell.json").write_text(json.dumps(begun | {"in all (s)": time.monotonic() - start}))
    return True


def evaluation(folder: Path, iteration: int | None = None) -> dict[str, Any]:
    """What an evaluation left in a folder, of any or of that iteration's policy; empty if there is none."""
    path = folder / "evaluation.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    return found if found and iteration in (None, found["settings"]["iteration"]) else {}


def curve(rows: Sequence[Mapping[str, str]]) -> Curve:
    """The columns of progress.csv as arrays, from the first finished episode on; NaN where there is no number."""
    rows = [row for row in rows if row.get("return")]
    return {name: np.array([float(row.get(name) or "nan") for row in rows]) for name in COLUMNS}


def passing(run: Curve, target: float, x: str) -> float:
    """Where on x the return of training first passes the target; inf where it does not."""
    at = np.flatnonzero(run["return"] >= target)
    return float(run[x][at[0]]) if len(at) else math.inf


def spread(values: Sequence[float]) -> str:
    if len(values) == 1:
        return f"{values[0]:.0f}"
    return f"{mean(values):.0f} ± {pstdev(values):.{int(pstdev(values) < 0.5)}f}"


# Results --------------------------------------------------------------------------------------------------------------


def same_numbers(revision: str, learner: str, task: str) -> bool:
    """Whether a training there is one of today."""
    return fingerprints.counts(revision, f"{LEARNERS[learner]} --env {task}")


def counts(row: Cells, timed: bool) -> bool:
    """Whether a cell's line is one of today, and has its seconds, if it is to be timed."""
    return same_numbers(row["revision"], row["learner"], row["task"]) and (not timed or bool(row["training (s)"]))


class Pace(NamedTuple):
    """Of a training that has its machine alone [s]."""

    start: float  # what the first iterations take longer than the others
    iteration: float

    def __call__(self, iterations: float) -> float:
        return self.start + self.iteration * iterations


def paces(directory: Path) -> dict[tuple[str, str], Pace]:
    """By learner and task."""
    keys = {(row["learner"], row["task"]): row for row in read_csv(directory / "pace.csv")}
    own = {key: row for key, row in keys.items() if same_numbers(row["revision"], *key)}
    return {key: Pace(*(float(row[f"{name} (s)"]) for name in Pace._fields)) for key, row in own.items()}


def read_cells(directory: Path) -> list[Cells]:
    """A machine's cells. One that has no seconds gets those of its pace, if that was measured."""
    rows, known = read_csv(directory / "cells.csv"), paces(directory)
    for row in rows:
        if (pace := known.get((row["learner"], row["task"]))) and not row["training (s)"]:
            row["training (s)"], row["paced"] = str(pace(float(row["iterations"]))), "*"
            each = float(row["control steps"]) / float(row["iterations"])
            for name in [name for name in row if name.startswith("control_steps to") and row[name]]:
                row[name.replace("control_steps", "seconds")] = str(pace(float(row[name]) / each))
    return rows


def done(rows: Sequence[Cells], cell: Cell) -> bool:
    own = [row for row in rows if (row["learner"], row["task"], row["seed"]) == (*cell[1:3], str(cell.seed))]
    return any(counts(row, cell.timed) for row in own)

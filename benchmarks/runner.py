"""Runs of the scripts, each in a folder of its own: what was interrupted goes on, what has finished is kept.

All is read from the files that the scripts write.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

import common
import numpy as np
from tables import ROOT, read_csv

import diffsim
from diffsim.sim.launcher import available_cores
from diffsim.training import checkpoint
from diffsim.training.evaluation import FINER, kept

COLUMNS = ("iteration", "control_steps", "seconds", "return", "length", "eval_return")  # kept of progress.csv
Curve = dict[str, np.ndarray]


@dataclass
class ScriptFlags(common.CommonFlags):
    device: str = "auto"  # torch device of the learners (auto: the GPU if there is one)
    time_limit: float | None = None  # seconds after which runs in progress stop and save; the next call goes on
    runs: Path = ROOT / "runs" / "learning"  # directory of the runs


class Case(NamedTuple):
    folder: Path
    env: str
    seed: int
    script: str
    flags: tuple[str, ...] = ()


class Runner:
    def __init__(self, args: ScriptFlags, jobs: int = 1) -> None:
        self.args, self.jobs = args, jobs
        self.stop_at = math.inf if args.time_limit is None else time.monotonic() + args.time_limit

    @property
    def time_is_up(self) -> bool:
        return time.monotonic() >= self.stop_at

    def run(self, cases: Iterable[Case], evaluate_only: bool = False) -> None:
        """Train and evaluate all, some at a time, as far as the time limit allows."""

        def finish(case: Case) -> None:
            ready = (case.folder / "checkpoint.pt").is_file() if evaluate_only else self.train(case)
            if ready and self.evaluate(case):
                print(f"{case.folder}: return {evaluation(case.folder)['return']:.1f}", flush=True)

        pool = ThreadPoolExecutor(self.jobs)
        try:
            list(pool.map(finish, cases))
        except KeyboardInterrupt:  # the scripts got it too, and save
            pool.shutdown(cancel_futures=True)
            sys.exit("interrupted; the same command goes on")

    def train(self, case: Case, until: int = 0) -> bool:
        """From where it stands to an iteration, 0: the last; whether it got there."""
        start: list[object] = ["--env", case.env, "--seed", case.seed, "--run-dir", case.folder, "--quiet", *case.flags]
        if (path := case.folder / "checkpoint.pt").is_file():
            state = checkpoint.load(path)
            if state["iteration"] >= (until or state["args"]["iterations"]):
                return True
            start = ["--resume", path]
        return self._call(case, *start, "--stop-after", until, *self.args.arguments)

    def evaluate(self, case: Case) -> bool:
        """Evaluate the checkpoint in all ways in which that is not done; whether it is now."""
        state = checkpoint.load(path := case.folder / "checkpoint.pt")
        settings: dict[Path, list[object]] = {case.folder: ["--no-finer"]}
        for substeps in checked(case.env, how := state["args"]):
            law = "mujoco" if how["integrator"] == "mujoco" else "semi_implicit"
            explicit = ["--integrator", law, "--theta", 0, "--substeps", FINER * substeps]
            settings[finer(case.folder, substeps)] = ["--no-finer", *explicit]
        return all(
            evaluation(folder, state["iteration"]) or self._call(case, "--evaluate", path, "--run-dir", folder, *flags)
            for folder, flags in settings.items()
        )

    def _call(self, case: Case, *arguments: object) -> bool:
        """Whether the script came to its end. It is stopped, and saves, when the time is up."""
        if self.time_is_up:
            return False
        command = [sys.executable, str(ROOT / f"{case.script}.py"), *map(str, arguments), "--device", self.args.device]
        if self.jobs > 1:
            command += ["--threads", str(max(1, available_cores() // self.jobs))]
        case.folder.mkdir(parents=True, exist_ok=True)
        with (case.folder / "output.txt").open("a") as output:
            process = subprocess.Popen(command, stdout=output, stderr=output)
            try:
                process.wait(None if self.stop_at == math.inf else self.stop_at - time.monotonic())
            except subprocess.TimeoutExpired:
                process.terminate()
                process.wait()
        if process.returncode:
            print(f"{case.folder}: stopped or failed, see output.txt there", flush=True)
        return process.returncode == 0


def checked(env: str, how: Mapping[str, Any]) -> tuple[int, int]:
    """Substeps of which the finer evaluations take multiples: a run's own, and the task's on that contact."""
    return how["substeps"], diffsim.TASKS[env].integration("default", how.get("contact", "soft")).substeps


def finer(folder: Path, substeps: int) -> Path:
    return folder / f"explicit_{FINER * substeps}"


def evaluation(folder: Path, iteration: int | None = None) -> dict[str, Any]:
    """What an evaluation left in a folder, of any or of that iteration's policy; empty if there is none."""
    path = folder / "evaluation.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    return found if found and iteration in (None, found["settings"]["iteration"]) else {}


def folders(directory: Path, env: str) -> list[Path]:
    """Those of a task's runs, by their seeds."""
    return sorted(directory.glob(f"{env}__*"), key=lambda folder: int(seed(folder)))


def seed(folder: Path) -> str:
    return folder.name.rpartition("__")[2]


def curve(rows: Sequence[Mapping[str, str]]) -> Curve:
    """The columns of progress.csv as arrays, from the first finished episode on; NaN where there is no number."""
    rows = [row for row in rows if row.get("return")]
    return {name: np.array([float(row.get(name) or "nan") for row in rows]) for name in COLUMNS}


def passing(runs: Sequence[Curve], target: float, x: str) -> list[float]:
    """Where on x, of each run, the return of training first passes the target; inf where it does not."""
    first = (np.flatnonzero(run["return"] >= target)[:1] for run in runs)
    return [float(run[x][at[0]]) if len(at) else math.inf for run, at in zip(runs, first, strict=True)]


def summary(directory: Path, env: str, targets: Sequence[float]) -> dict[str, object]:
    """Medians over the runs of a task that have been evaluated in all ways, and each one's return; empty if none has.

    Args:
        targets: returns whose passing is timed.
    """
    task, runs, rows = diffsim.TASKS[env], [], []
    for folder in folders(directory, env):
        if own := evaluation(folder):
            how = own["settings"]
            checks = [evaluation(finer(folder, n), how["iteration"]) for n in checked(env, how)]
            if all(checks):
                progress = read_csv(folder / "progress.csv")
                rows.append(next(row for row in progress if int(row["iteration"]) == how["iteration"]))
                runs.append((seed(folder), own, *checks, curve(progress)))
    if not runs:
        return {}
    seeds, owns, finers, references, curves = zip(*runs, strict=True)
    own, finest, reference = (median(found["return"] for found in each) for each in (owns, finers, references))
    alone = [float(row["seconds"]) for row in rows if row["seconds"]]  # runs that shared their machine have none
    timed = [curve for curve in curves if not np.isnan(curve["seconds"]).any()]
    falls = (mean(length < task.episode_length for length in found["lengths"]) for found in owns)
    return {
        "integrator": how["integrator"],
        "substeps": how["substeps"],
        "seeds": " ".join(seeds),
        "iterations": f"{median(int(row['iteration']) for row in rows):g}",
        "training (s)": f"{median(alone):.0f}" if alone else "",
        "return": f"{own:.0f}",
        "each seed": " ".join(f"{found['return']:.0f}" for found in owns),
        f"explicit, substeps x{FINER}": f"{finest:.0f}",
        "kept": f"{kept(own, finest):.3f}",
        "in the reference": f"{reference:.0f}",
        "speed (m/s)": " ".join(f"{found['speed']:.2f}" for found in owns if found["speed"] is not None),
        "falls per episode": " ".join(f"{share:.2f}" for share in falls),
        "return passes": "; ".join(words(target, passing(timed, target, "seconds")) for target in targets if timed),
    }


def words(target: float, seconds: Sequence[float]) -> str:
    """When the median run passes a return, and where it does not, how many do."""
    passed = [s for s in seconds if s < math.inf]
    if median(seconds) < math.inf:
        return f"{target:g} after {median(seconds):.0f} s"
    return f"{target:g} by {len(passed)} of {len(seconds)}, after {min(passed):.0f} s" if passed else f"{target:g} not"

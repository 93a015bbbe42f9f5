"""What the trade does to learning: SHAC at each accuracy, and on a stiff ground, judged in a finer simulator.

    python benchmarks/gate.py --jobs 9 --device cuda                     five tasks x presets x three seeds
    python benchmarks/gate.py --env hopper --variants stiff --jobs 3 --device cuda
    python benchmarks/gate.py --evaluate-only                           evaluate the runs there are, and draw the table
    python benchmarks/gate.py --collect-only                            only draw the table

What follows "--" goes to shac.py. Finished runs are kept and interrupted ones resumed. Each final policy is evaluated
where it was trained, explicitly with four times the substeps (the gate: 97 % of the median return must be kept), and in
the task's reference, the same for all: explicit with four times the default's substeps. Writes
benchmarks/results/gate.csv and the table of docs/accuracy.md.
"""

from __future__ import annotations

import json
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import learning
import tyro
from common import DOCS, RESULTS, ROOT
from tables import fill, markdown, merge_csv, read_csv

import diffsim
from diffsim.run import fail

STIFF = ("--penalty", "k_n=1e5", "k_d=1e4")  # on which published SHAC's hopper falls from 4,794 to 1,603
VARIANTS = {
    "fast": ("--accuracy", "fast"),
    "default": ("--accuracy", "default"),
    "accurate": ("--accuracy", "accurate"),
    "stiff": STIFF,
    "stiff fast": (*STIFF, "--accuracy", "fast"),
    "stiff accurate": (*STIFF, "--accuracy", "accurate"),
    "stiff implicit": (*STIFF, "--integrator", "implicit"),
    # tried for "fast"
    "explicit 8": ("--integrator", "semi_implicit", "--substeps", "8"),
    "explicit 12": ("--integrator", "semi_implicit", "--substeps", "12"),
    "implicit 16": ("--integrator", "implicit", "--substeps", "16"),
}


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = (
        "cartpole",
        "hopper",
        "half_cheetah",
        "ant",
        "humanoid",
    )
    """tasks"""
    variants: tuple[str, ...] = ("fast", "default", "accurate")
    """fast, default, accurate; stiff, stiff fast, stiff accurate, stiff implicit; what was tried for fast:
    explicit 8, explicit 12, implicit 16"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of each"""
    device: str | None = None
    """torch device of the learners; None: the GPU if there is one"""
    jobs: int = 1
    """runs at a time; they share the device"""
    time_limit: float | None = None
    """seconds after which the runs in progress are stopped, to be resumed by the next call; None: no limit"""
    runs: Path = ROOT / "runs" / "gate"
    """directory of the runs: {runs}/{variant}/shac/{env}__{seed}"""
    output: Path = RESULTS
    """directory of the table"""
    evaluate_only: bool = False
    """train nothing; runs that did not finish are evaluated where they stand"""
    collect_only: bool = False
    """train and evaluate nothing"""


def folder(args: Args, variant: str) -> Path:
    return args.runs / variant.replace(" ", "_")


def judge(settings: learning.Args, run: Path, env: str) -> None:
    """Completes evaluation.json: the return where it was trained, in a finer simulator, and in the reference."""
    path, checkpoint = run / "evaluation.json", run / "checkpoint.pt"
    if not checkpoint.is_file():
        return
    evaluation = json.loads(path.read_text()) if path.is_file() else {}
    counts = {"finer": 4 * json.loads((run / "args.json").read_text())["substeps"]}
    counts["reference"] = 4 * diffsim.TASKS[env].substeps
    explicit = {key: ("--substeps", count, "--integrator", "semi_implicit") for key, count in counts.items()}
    for key, setting in {"own": (), **explicit}.items():
        if key not in evaluation:
            text = learning.call(settings, run, "--evaluate", checkpoint, *setting)
            found = re.search(r"return median (-?[\d.]+)", text or "")
            if not found:
                print(f"{run}: not evaluated, see {run / 'output.txt'}", flush=True)
                return
            evaluation[key] = float(found[1])
    path.write_text(json.dumps(evaluation))


def collect(args: Args, variant: str, env: str) -> dict[str, Any] | None:
    found: dict[str, list[float]] = {"own": [], "finer": [], "reference": []}
    seeds, seconds, iterations, settings = [], [], [], {}
    for run in sorted((folder(args, variant) / "shac").glob(f"{env}__*")):
        if (run / "evaluation.json").is_file():
            evaluation, settings = (json.loads((run / f"{name}.json").read_text()) for name in ("evaluation", "args"))
            if not found.keys() <= evaluation.keys():
                continue
            last = read_csv(run / "progress.csv")[-1]
            seconds.append(float(last["seconds"]))
            iterations.append(int(last["iteration"]))
            seeds.append(run.name.split("__")[1])
            for key, values in found.items():
                values.append(evaluation[key])
    if not seeds:
        return None
    own, finer, reference = (median(values) for values in found.values())
    kept = finer / own if own > 0 else own / finer
    return {
        "task": env,
        "variant": variant,
        "integrator": settings["integrator"],
        "substeps": settings["substeps"],
        "seeds": " ".join(seeds),
        "iterations": median(iterations),
        "training (s)": f"{median(seconds):.0f}",
        "return": f"{own:.0f}",
        "each seed": " ".join(f"{value:.0f}" for value in found["own"]),
        "explicit, substeps x4": f"{finer:.0f}",
        "kept": f"{kept:.3f}",
        "gate": "passed" if kept >= 0.97 else "failed",
        "in the reference": f"{reference:.0f}",
    }


def main(args: Args, arguments: tuple[str, ...]) -> None:
    if unknown := [name for name in args.env if name not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    if unknown := [name for name in args.variants if name not in VARIANTS]:
        fail(f"unknown variant {unknown[0]!r}: choose from {', '.join(VARIANTS)}")

    stop_at = time.monotonic() + args.time_limit if args.time_limit is not None else float("inf")

    def finish(job: tuple[str, int, str]) -> None:
        env, seed, variant = job
        options = dict(runs=folder(args, variant), jobs=args.jobs, device=args.device, stop_at=stop_at)
        settings = learning.Args(arguments=(*VARIANTS[variant], *arguments), **options)
        if not args.evaluate_only:
            learning.train(settings, env, seed)
        run = learning.run_dir(settings, env, seed)
        if args.evaluate_only or (run / "evaluation.json").is_file():
            judge(settings, run, env)

    if not args.collect_only:
        slowest_first = reversed([name for name in diffsim.TASKS if name in args.env])
        jobs = [(env, seed, variant) for env in slowest_first for variant in args.variants[::-1] for seed in args.seeds]
        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(finish, jobs))
    found = [row for env in diffsim.TASKS for variant in VARIANTS if (row := collect(args, variant, env))]
    path = args.output / "gate.csv"
    if found:
        merge_csv(path, found, ("task", "variant"))
    if not path.is_file():
        fail(f"no evaluated run in {args.runs}")
    text = markdown(read_csv(path))
    if args.output == RESULTS:
        fill(DOCS / "accuracy.md", "learning", text)
    print(text, end="")


if __name__ == "__main__":
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    main(tyro.cli(Args, args=sys.argv[1:split], description=__doc__), (*sys.argv[split + 1 :],))

"""Tabulates and draws training runs of humanoid_mtu: return, forward speed, falls, and when the published returns pass.

    python shac.py --env humanoid_mtu --seed 1 --device cuda --run-dir runs/mtu/64__1        first, for some seeds
    python shac.py --env humanoid_mtu --seed 1 --device cuda --num-envs 1024 --run-dir runs/mtu/1024__1
    python benchmarks/humanoid_mtu.py runs/mtu/*                 then evaluate them, tabulate and draw
    python benchmarks/humanoid_mtu.py --draw-only                only from the csv files

Writes docs/results/humanoid_mtu_{runs,curves}.csv, docs/humanoid_mtu.png, and the table of docs/humanoid_mtu.md.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import matplotlib
import numpy as np
import tyro
from tables import fill, read_csv, write_csv

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import shac  # noqa: E402
from diffsim.evaluation import evaluate  # noqa: E402
from diffsim.run import fail  # noqa: E402
from diffsim.tasks.humanoid_mtu import HumanoidMTU  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

# Georgiev et al. 2024, "Adaptive Horizon Actor-Critic": best points of the curves of PPO, SHAC and AHAC.
PUBLISHED = {"PPO": 4246, "SHAC": 6114, "AHAC": 6964}
POINTS = 200  # kept of each curve


@dataclass
class Args:
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """directories of runs of shac.py, finished or not"""
    device: str | None = None
    """torch device of the evaluations; None: the GPU if there is one"""
    episodes: int = 64
    """episodes of an evaluation"""
    draw_only: bool = False
    """evaluate nothing: table and picture from the csv files"""
    docs: Path = ROOT / "docs"
    """directory of what is written"""


SETTING = ("environments", "substeps", "device")  # equal in the runs of one line, which differ in their seeds


def setting(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in SETTING)


def read_run(args: Args, folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The run's row of the table, and its curve."""
    device = ["--device", args.device] if args.device else []
    command = ["--evaluate", str(folder / "checkpoint.pt"), "--eval-episodes", str(args.episodes), *device]
    options, checkpoint = shac.parse(command)
    if options.env != HumanoidMTU.name:
        fail(f"{folder} is a run of {options.env}, not of {HumanoidMTU.name}")
    progress = read_csv(folder / "progress.csv")
    if checkpoint["iteration"] < options.iterations:
        print(f"{folder}: stopped at iteration {checkpoint['iteration']} of {options.iterations}", file=sys.stderr)
    env = shac.make_env(options, args.episodes, horizon=1)
    actor, normalise = shac.build(options, env)
    actor.load_state_dict(checkpoint["actor"])
    normalise.load_state_dict(checkpoint["normalise"])
    evaluation = evaluate(env, lambda obs: actor(normalise(obs)))
    saved = json.loads((folder / "args.json").read_text())
    substeps = f"{options.substeps}{'' if options.integrator == 'semi_implicit' else f', {options.integrator}'}"
    key = {"environments": options.num_envs, "substeps": substeps, "device": saved["device"].partition(":")[0]}
    key |= {"seed": options.seed}
    row = key | {
        "iterations": checkpoint["iteration"],
        "return": f"{evaluation.returns.median():.0f}",
        "speed (m/s)": f"{evaluation.speed:.2f}",
        "falls per episode": f"{(evaluation.lengths < env.episode_length).float().mean():.2f}",
    }
    for least in PUBLISHED.values():
        passed = next((r for r in progress if r["return"] and float(r["return"]) >= least), None)
        row[f"steps to {least}"] = passed["control_steps"] if passed else ""
        row[f"seconds to {least}"] = f"{float(passed['seconds']):.0f}" if passed else ""
    print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
    columns = ("control_steps", "seconds", "return", "length")
    kept = np.linspace(0, len(progress) - 1, min(POINTS, len(progress))).round().astype(int)
    return row, [key | {c: progress[k][c] and f"{float(progress[k][c]):.6g}" for c in columns} for k in kept]


def write_table(args: Args, rows: list[dict[str, str]]) -> None:
    """Rows of equal settings become one line: the median over the seeds, and each seed's value."""
    lines = [
        "| environments | substeps | device | seeds | iterations | return | forward speed | falls per episode "
        + "".join(f"| training return passes {least:,} " for least in PUBLISHED.values())
        + "|",
        "|" + "---|" * (8 + len(PUBLISHED)),
    ]

    def cell(group: list[dict[str, str]], column: str, unit: str = "") -> str:
        each = f" ({', '.join(row[column] for row in group)})" if len(group) > 1 else ""
        return f"{median(float(row[column]) for row in group):g}{unit}{each}"

    def passing(row: dict[str, str], least: int) -> str:
        steps, seconds = row[f"steps to {least}"], row[f"seconds to {least}"]
        return f"{float(steps) / 1e6:.2f} M steps, {seconds} s" if steps else "not"

    for key in dict.fromkeys(setting(row) for row in rows):
        group = [row for row in rows if setting(row) == key]
        cells = [*key, " ".join(row["seed"] for row in group)]
        cells += [cell(group, "iterations"), cell(group, "return"), cell(group, "speed (m/s)", " m/s")]
        cells += [cell(group, "falls per episode")]
        cells += ["; ".join(passing(row, least) for row in group) for least in PUBLISHED.values()]
        lines.append("| " + " | ".join(cells) + " |")
    fill(args.docs / "humanoid_mtu.md", "results", "\n".join(lines) + "\n")
    print("\n".join(lines))


def draw(args: Args, points: list[dict[str, str]]) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    settings = list(dict.fromkeys(setting(point) for point in points))
    for key, seed in dict.fromkeys((setting(point), point["seed"]) for point in points):
        curve = [p for p in points if (setting(p), p["seed"]) == (key, seed) and p["return"]]
        colour = f"C{settings.index(key)}"
        for axis, column, scale in ((axes[0], "control_steps", 1e-6), (axes[1], "seconds", 1 / 60)):
            x = [scale * float(p[column]) for p in curve]
            axis.plot(x, [float(p["return"]) for p in curve], colour, lw=1, label=" / ".join(key))
    for axis, label in zip(axes, ("control steps, millions", "minutes of training"), strict=True):
        for name, value in PUBLISHED.items():
            axis.axhline(value, color="0.4", linestyle="--", linewidth=0.8)
            axis.annotate(name, (1, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7)
        axis.set_xlabel(label)
        axis.set_xlim(left=0)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("return of training episodes")
    labels = dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
    axes[0].legend(labels.values(), labels, title=" / ".join(SETTING), fontsize=7, title_fontsize=7)
    figure.savefig(args.docs / "humanoid_mtu.png", dpi=110)


def main(args: Args) -> None:
    paths = [args.docs / "results" / f"humanoid_mtu_{name}.csv" for name in ("runs", "curves")]
    if not args.draw_only:
        if not args.runs:
            fail("give the directories of runs, or --draw-only")
        rows, curves = zip(*(read_run(args, folder) for folder in args.runs), strict=True)
        write_csv(paths[0], sorted(rows, key=lambda row: (row["environments"], row["substeps"], row["seed"])))
        write_csv(paths[1], [point for curve in curves for point in curve])
    if not all(path.is_file() for path in paths):
        fail(f"no results in {args.docs / 'results'} yet: give the directories of runs")
    write_table(args, read_csv(paths[0]))
    draw(args, read_csv(paths[1]))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

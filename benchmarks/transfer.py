"""The share of speed that policies retain in another simulator: trained here and judged in MuJoCo, or the reverse.

    python benchmarks/transfer.py runs/learning/shac/ant__1            a run, or a checkpoint of any learner's script
    python benchmarks/transfer.py runs/learning/*/* --friction 0.5 0.7 1 1.3 1.5

A policy acts from the same start states in several worlds, of which each step changes one thing:

    here         this simulator, as in training
    MuJoCo same  of contact mujoco: MuJoCo with the substeps and the elliptic cones of the training: the same law
    MuJoCo x1    MuJoCo with its own contact and limits, cones and timestep on the same file
    MuJoCo x0.5  and so on, with other friction

A policy that peer.py trained in mujoco_warp was trained in "MuJoCo same", and what it keeps is its share of that speed.

Writes transfer.csv, a row for each policy and world, and with --update-results the table of docs/transfer.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median

import common
import numpy as np
from common import ABOUT, Case, Part, load_case, measured, run
from tables import Row, grouped, middle, numbers
from worlds import Here, Motion, MuJoCo, World, travel

import diffsim
from diffsim import DiffEnv
from diffsim.training import Count, Positive, fail
from diffsim.training.checkpoint import HOME

SAME = "MuJoCo same"  # with the law and the substeps of contact mujoco


@dataclass
class Args(common.CheckpointFlags):
    episodes: Count = 64  # start states, the same in every world
    steps: Count = 1000  # control steps at most
    friction: tuple[Positive, ...] = (0.5, 1.0, 1.5)  # friction in MuJoCo, in multiples of the file's mu


def speed(motion: Motion, control_dt: float, forward: int) -> float:
    """Mean forward speed over all control steps of all episodes, m/s."""
    x = motion.qpos[..., forward]
    return float((np.take_along_axis(x, motion.lengths[None], 0)[0] - x[0]).sum() / (control_dt * motion.lengths.sum()))


def summary(motion: Motion, env: DiffEnv) -> dict[str, object]:
    """The csv's columns of one motion."""
    column = env.task.forward_column
    return {
        "return": float(np.median(motion.returns)),
        "speed": "" if column is None else speed(motion, env.control_dt, column),
        "whole": float((~motion.fallen).mean()),
    }


def in_mujoco(case: Case) -> dict[str, object]:
    """`summary` of a policy under MuJoCo's own contact on the file as it is; empty of muscles: the file has none."""
    env = case.env
    if "muscle" in env.scene.features:
        return {}
    exact = env.sim.integration.contact == "mujoco"
    world = MuJoCo(env.scene, env.num_envs, env.control_dt, own_friction=exact)
    return summary(travel(case, world, env.episode_length), env)


def conditions(case: Case, args: Args) -> dict[str, World]:
    """The worlds, by the names that the csv gives them; the first is that of the training."""
    env, scene, n, how = case.env, case.env.scene, case.env.num_envs, case.env.sim.integration
    exact, dt = how.contact == "mujoco", env.control_dt
    worlds: dict[str, World] = {SAME: MuJoCo(scene, n, dt, 1.0, exact, how.substeps)} if exact else {}
    worlds |= {"here": Here(env.sim)}
    first = SAME if exact and case.saved.simulator != HOME else "here"
    for friction in args.friction if scene.ncontact else (1.0,):
        worlds[f"MuJoCo x{friction:g}"] = MuJoCo(scene, n, dt, friction, own_friction=exact)
    return {first: worlds[first], **worlds}


def measure(args: Args, path: Path) -> Iterator[Row]:
    """A row for each world. What cannot be compared ends the benchmark with one line."""
    case = load_case(path, args.episodes, args.device)
    env, how, own = case.env, case.env.sim.integration, math.nan
    trained_on = f"{case.path} was trained on {env.task.name}, whose"
    if "muscle" in env.scene.features:
        fail(f"{trained_on} muscles are not simulated in MuJoCo here")
    if env.task.num_memory:
        fail(f"{trained_on} policy depends on the past: choose one of another task")
    for name, world in conditions(case, args).items():
        motion = travel(case, world, args.steps)
        row = case.about | {"trained in": case.saved.simulator, "condition": name}
        row |= {"substeps": how.substeps} | summary(motion, env)
        if isinstance(value := row["speed"], float):
            own = value if math.isnan(own) else own
            row["kept"] = value / own
        yield row | {"episodes": args.episodes, "steps": args.steps}


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task, contact and learner, over its seeds: medians of the speed in m/s, or of the return of a
    robot that does not travel; what is kept of the training's own speed in the other simulator, the median and the
    worst; mean shares of whole episodes here and in MuJoCo.

    Runs that are not named {learner}/{task}__{seed} have a line each.
    """
    for row in rows:
        folder, _, run = row["checkpoint"].rpartition("/")
        row["learner"] = folder if run == f"{row['task']}__{row['seed']}" else row["checkpoint"]
    tasks = [*diffsim.TASKS, *(row["task"] for row in rows)]
    rows = sorted(rows, key=lambda row: (tasks.index(row["task"]), row["contact"] != "soft"))
    names, lines = {row["condition"] for row in rows}, list[Row]()
    worlds = sorted((name for name in names if name.startswith("MuJoCo x")), key=lambda name: float(name[8:]))
    for (task, _, learner, home), own in grouped(rows, "task", "contact", "learner", "trained in").items():
        group = {name: found for (name,), found in grouped(own, "condition").items()}
        unit = ("speed", ".2f") if group["here"][0]["speed"] else ("return", ".0f")
        kept = numbers(group.get("MuJoCo x1" if home == HOME else "here", []), "kept")
        shares = [mean(numbers(group[name], "whole")) for name in ("here", *worlds) if name in group]
        lines.append(
            {"task": task, "learner": learner, "seeds": len(group["here"])}
            | {name: middle(group.get(name, []), *unit) for name in ("here", "MuJoCo x1")}
            | {"retained (worst)": f"{median(kept):.0%} ({min(kept):.0%})" if kept else ""}
            | {"episodes without a fall": " / ".join(f"{share:.0%}" for share in shares)}
        )
    return lines


def main(args: Args) -> None:
    measured(args, Part("transfer", measure, (*ABOUT[:-1], "condition"), "transfer", "transfer.md", table))


if __name__ == "__main__":
    run(main, Args, __doc__)

"""What policies keep of their speed in another simulator: of those trained here in MuJoCo, and the other way round.

    python benchmarks/transfer.py runs/learning/shac/ant__1            a run, or a checkpoint of any learner's script
    python benchmarks/transfer.py runs/learning/*/* --friction 0.5 0.7 1 1.3 1.5
    python benchmarks/transfer.py runs/learning/shac/ant__1 --episodes 8 --video both.mp4

A policy acts from the same start states in several worlds, of which each step changes one thing:

    here         this simulator, as in training
    finer        this simulator with finer steps, explicit ones unless its contact is MuJoCo's: the integration
    MuJoCo same  of contact mujoco: MuJoCo with the substeps and the elliptic cones of the training: the same law
    MuJoCo x1    MuJoCo with its own contact and limits, cones and timestep on the same file
    MuJoCo x0.5  and so on, with other friction

A policy that peer.py trained in mujoco_warp was trained in "MuJoCo same", and what it keeps is its share of that speed.

Writes transfer.csv, a row for each policy and world, and with --update-results the table of docs/transfer.md. The video
shows the same start here (left) and in MuJoCo (right).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean, median

import common
import numpy as np
from common import ABOUT, Case, load_case, run
from groups import grouped, middle, numbers
from numpy.typing import NDArray
from tables import Row, markdown
from worlds import Here, Motion, MuJoCo, World, travel

import diffsim
from diffsim import DiffEnv, Integration, Scene, Simulator
from diffsim.training import Count, Positive, fail, gait
from diffsim.training.checkpoint import HOME
from diffsim.training.evaluation import FINER, VIDEO_SECONDS
from diffsim.view import render

KEY = (*ABOUT[:-1], "condition")
SAME = "MuJoCo same"  # with the law and the substeps of contact mujoco


@dataclass
class Args(common.CheckpointFlags):
    episodes: Count = 64  # start states, the same in every world
    steps: Count = 1000  # control steps at most
    friction: tuple[Positive, ...] = (0.5, 1.0, 1.5)  # friction in MuJoCo, in multiples of the file's mu
    finer: Count = FINER  # steps of "finer" in multiples of the task's substeps
    video: Path | None = None  # write the episode of median return, here and in MuJoCo side by side: .mp4 or .gif


# Motions --------------------------------------------------------------------------------------------------------------


def load(path: Path, args: Args) -> Case:
    """The policy of a checkpoint or of a run's; what cannot be compared ends the benchmark with one line."""
    case = load_case(path, args.episodes, args.device)
    name = case.env.task.name
    if "muscle" in case.env.scene.features:
        fail(f"{case.path} was trained on {name}, whose muscles are not simulated in MuJoCo here")
    if case.env.task.num_memory:
        fail(f"{case.path} was trained on {name}, whose policy depends on the past: choose one of another task")
    return case


def speed(motion: Motion, control_dt: float, forward: int = 0) -> float:
    """Mean forward speed over all control steps of all episodes, m/s."""
    x = motion.qpos[..., forward]
    return float((np.take_along_axis(x, motion.lengths[None], 0)[0] - x[0]).sum() / (control_dt * motion.lengths.sum()))


def feet(scene: Scene) -> list[NDArray[np.bool_]]:
    """Which of the contact spheres (nc,) are of each foot: a body at the end of a limb, which carries no other."""
    body, parents = gait.contact_bodies(scene), scene.mj_model.body_parentid
    return [body == k for k in np.unique(body) if k not in parents and parents[k]]


def measure(motion: Motion, scene: Scene, control_dt: float, forward: int | None = 0) -> dict[str, object]:
    """The csv's columns of one motion; empty ones where there is no ground, or no foot on it."""
    row: dict[str, object] = {
        "return": float(np.median(motion.returns)),
        "speed": "" if forward is None else speed(motion, control_dt, forward),
        "whole": float((~motion.fallen).mean()),
    }
    deepest = np.zeros(0)
    if "contact" in scene.features:
        frames = np.arange(1, len(motion.qpos))[:, None] <= motion.lengths  # the states after each step
        depth = gait.trace(scene, motion.qpos[1:][frames])[0]
        deepest = np.concatenate([depth[:, foot].max(1) for foot in feet(scene)])
    middle, most = np.percentile(1e3 * deepest[deepest > 0], (50, 95)) if (deepest > 0).any() else ("", "")
    return row | {"penetration": middle, "penetration 95 %": most}


def in_mujoco(case: Case) -> dict[str, object]:
    """`measure` of a policy under MuJoCo's own contact on the file as it is; empty of muscles: the file has none."""
    env = case.env
    if "muscle" in env.scene.features:
        return {}
    motion = travel(case, MuJoCo(env.scene, env.num_envs, env.control_dt), env.episode_length)
    return measure(motion, env.scene, env.control_dt, env.task.forward_column)


def conditions(case: Case, args: Args) -> dict[str, World]:
    """The worlds, by the names that the csv gives them; the first is that of the training."""
    env, scene, n, how = case.env, case.env.scene, case.env.num_envs, case.env.sim.integration
    exact, dt = how.integrator == "mujoco", env.control_dt
    finer = how._replace(substeps=args.finer * how.substeps)
    if not exact:
        finer = Integration("semi_implicit", args.finer * env.task.substeps)
    worlds: dict[str, World] = {SAME: MuJoCo(scene, n, dt, 1.0, exact, how.substeps)} if exact else {}
    worlds |= {"here": Here(env.sim), "finer": Here(Simulator(scene, n, finer, dt, device=env.device))}
    first = SAME if exact and case.saved.simulator != HOME else "here"
    for friction in args.friction if scene.ncontact else (1.0,):
        worlds[f"MuJoCo x{friction:g}"] = MuJoCo(scene, n, dt, friction, own_friction=exact)
    return {first: worlds[first], **worlds}


def compare(case: Case, args: Args) -> dict[str, Motion]:
    """The motions of one policy by their worlds; each is in the csv as soon as it is measured."""
    env, how = case.env, case.env.sim.integration
    motions, own = dict[str, Motion](), math.nan
    for name, world in conditions(case, args).items():
        motion = motions[name] = travel(case, world, args.steps)
        found = measure(motion, env.scene, env.control_dt, env.task.forward_column)
        if isinstance(value := found["speed"], float):
            own = value if len(motions) == 1 else own
            found["kept"] = value / own
        row = case.about | {"trained in": case.saved.simulator, "condition": name}
        row |= {"integrator": how.integrator, "substeps": how.substeps}
        row |= found | {column: getattr(args, column) for column in ("episodes", "steps", "finer")}
        args.keep("transfer", row, KEY)
    return motions


# What is shown --------------------------------------------------------------------------------------------------------


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task, contact and learner, over its seeds: medians of the speed in each world in m/s, or of the
    return of a robot that does not travel, what is kept of the training's own speed in the world that judges, mean
    shares of whole episodes here and in MuJoCo, medians of the feet's penetration.

    Runs that are not named {learner}/{task}__{seed} have a line each.
    """

    def learner_of(row: dict[str, str]) -> str:
        folder, _, run = row["checkpoint"].rpartition("/")
        return folder if run == f"{row['task']}__{row['seed']}" else row["checkpoint"]

    rows = [row | {"learner": learner_of(row), "trained in": row.get("trained in") or HOME} for row in rows]
    tasks = [*diffsim.TASKS, *(row["task"] for row in rows)]
    rows = sorted(rows, key=lambda row: (tasks.index(row["task"]), row["contact"] != "soft"))
    names, lines = {row["condition"] for row in rows}, list[Row]()
    worlds = sorted((name for name in names if name.startswith("MuJoCo x")), key=lambda name: float(name[8:]))
    for (task, contact, learner, home), own in grouped(rows, "task", "contact", "learner", "trained in").items():
        group = {name: found for (name,), found in grouped(own, "condition").items()}
        here, there = group["here"], group.get("MuJoCo x1", [])
        unit = ("speed", ".2f") if here[0]["speed"] else ("return", ".0f")
        trained, judge = ("here", "MuJoCo x1") if home == HOME else (home, "here")
        kept = numbers(group.get(judge, []), "kept")
        shares = [mean(numbers(group[name], "whole")) for name in ("here", *worlds) if name in group]
        speeds = {name: middle(group.get(name, []), *unit) for name in ("here", *({SAME} & names), *worlds)}
        lines.append(
            {"task": task, "contact": contact, "learner": learner, "seeds": len(here)}
            | speeds
            | {"trained in": trained, "judged in": judge}
            | {"kept": f"{median(kept):.0%}" if kept else "", "worst": f"{min(kept):.0%}" if kept else ""}
            | {"whole": " / ".join(f"{share:.0%}" for share in shares)}
            | {"depth here": middle(here, "penetration", ".1f"), "depth MuJoCo x1": middle(there, "penetration", ".1f")}
        )
    return lines


def film(path: Path, env: DiffEnv, here: Motion, there: Motion) -> None:
    """The episode of median return here (left), and its start there (right), small as a gif; the fallen lie there."""
    episode = int(here.returns.argsort()[(len(here.returns) - 1) // 2])
    stride = max(1, math.ceil(1 / (render.VIDEO_FPS * env.control_dt) - 1e-6))
    size, seconds = ((288, 208), 4.0) if path.suffix == ".gif" else (render.VIDEO_SIZE, VIDEO_SECONDS)
    renderer = partial(render.Renderer, env.scene, *size)
    count = min(max(here.lengths[episode], there.lengths[episode]), round(seconds / env.control_dt))
    with renderer() as left, renderer() as right:
        sides = (left, here), (right, there)
        frames = (
            np.concatenate([side.draw(m.qpos[min(k, m.lengths[episode]), episode]) for side, m in sides], 1)
            for k in range(0, count, stride)
        )
        print(render.save_video(path, frames, 1 / (stride * env.control_dt)))


def main(args: Args) -> None:
    paths = args.measured
    if args.video:
        if len(paths) != 1 or 1.0 not in args.friction:
            fail("--video shows one checkpoint, and MuJoCo at the file's friction (--friction 1)")
        try:
            render.check_video(args.video, (2 * render.VIDEO_SIZE[0], render.VIDEO_SIZE[1]))
            render.check_opengl()
        except (ValueError, RuntimeError) as error:
            fail(f"--video: {error}")
    for case in [load(path, args) for path in paths]:
        print(f"{case.label}: {case.saved.args['env']}, {case.saved.script}.py", flush=True)
        motions = compare(case, args)
        if args.video:
            film(args.video, case.env, motions["here"], motions["MuJoCo x1"])
    args.publish("transfer", markdown(table(args.read("transfer"))), "transfer.md")


if __name__ == "__main__":
    run(main, Args, __doc__)

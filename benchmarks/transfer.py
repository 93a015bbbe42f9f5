"""What policies keep of their speed in MuJoCo: the accuracy of the contact model, not of the integration.

    python benchmarks/transfer.py runs/learning/shac/ant__1            a run, or a checkpoint of any learner's script
    python benchmarks/transfer.py runs/learning/*/* --friction 0.5 0.7 1 1.3 1.5
    python benchmarks/transfer.py runs/learning/shac/ant__1 --episodes 8 --video both.mp4 --curves

A policy acts from the same start states in several worlds, of which each step changes one thing:

    here        this simulator, as in training
    finer       this simulator with finer, explicit steps: the integration
    control     MuJoCo's dynamics, this simulator's contact and limits as external forces, steps of "finer": nothing, or
                the comparison is wrong
    MuJoCo x1   MuJoCo with its own contact and limits on the same file: the model of contact and limits
    MuJoCo x0.5 and so on, with other friction

Writes transfer.csv, a row for each policy and world, transfer.png with --curves, and with --update-results the table
of docs/transfer.md. The video shows the same start here (left) and in MuJoCo (right).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean, median

import common
import numpy as np
import torch
import worlds
from common import Case, Line, Panel, load_case, parse, plot
from tables import Row, digits, markdown
from torch import Tensor
from worlds import Array, Flags, World

import diffsim
from diffsim import DiffEnv, Integration, Scene, Simulator
from diffsim.tasks import Task
from diffsim.training import Count, Positive, fail
from diffsim.training.evaluation import FINER, SEED, travels
from diffsim.view import render

KEY = ("checkpoint", "task", "learner", "contact", "seed", "condition")
SHOWN = 5.0  # s of an episode in the picture
STYLES = {"here": "C0-", "control": "C1--", "MuJoCo x1": "C2-"}


@dataclass
class Args(common.CheckpointFlags):
    episodes: Count = 64  # start states, the same in every world
    steps: Count = 1000  # control steps at most
    friction: tuple[Positive, ...] = (0.5, 1.0, 1.5)  # of MuJoCo, in multiples of the file's mu
    control: bool = True  # run "finer" and "control" too, which check the comparison and take most of its time
    finer: Count = FINER  # steps of "finer" and of the control in multiples of the task's substeps
    video: Path | None = None  # write the episode of median return, here and in MuJoCo side by side: .mp4 or .gif
    curves: bool = False  # draw that episode's speed and penetration against time


def load(path: Path, args: Args) -> Case:
    """The policy of a checkpoint or of a run's; what cannot be compared ends the benchmark with one line."""
    case = load_case(path, args.episodes, args.device)
    name = case.env.task.name
    if "muscle" in case.env.scene.features:
        fail(f"{case.path} was trained on {name}, whose muscles are not simulated in MuJoCo here")
    if name not in worlds.OBSERVED:
        fail(f"{case.path} was trained on {name}, whose observation worlds.py does not compute")
    return case


# Motions --------------------------------------------------------------------------------------------------------------


@dataclass
class Motion:
    """The first episode of each of n robots in one world.

    Attributes:
        qpos, qvel: (T + 1, n, nq), (T + 1, n, nv) from the start on; valid up to an episode's length.
        returns: (n,).
        lengths: (n,) control steps.
        fallen: (n,) whether the episode ended with a fall.
    """

    qpos: Array
    qvel: Array
    returns: Array
    lengths: np.ndarray
    fallen: Flags


@torch.no_grad()
def act(
    world: World, task: Task, policy: Callable[[Tensor], Tensor], qpos: Array, qvel: Array, nu: int, steps: int
) -> Motion:
    """Episodes of at most so many steps in a world, from qpos (n, nq) and qvel (n, nv).

    Args:
        task: of float64, on the CPU; says what is rewarded, and who has fallen.
        policy: observations (n, obs_dim) in float32 -> actions (n, nu).
    """
    n = len(qpos)
    alive, fallen, returns, lengths = np.ones(n, bool), np.zeros(n, bool), np.zeros(n), np.zeros(n, int)
    obs = worlds.observe(task.name, qpos, qvel, np.zeros((n, nu)))
    path = [(qpos, qvel)]
    for _ in range(steps):
        action = policy(torch.from_numpy(obs).float()).clamp(-1.0, 1.0).double()
        qpos, qvel, lost = world.step(qpos, qvel, action.numpy(), alive)
        path.append((qpos, qvel))
        obs = worlds.observe(task.name, qpos, qvel, action.numpy())
        seen = torch.from_numpy(obs)
        returns += np.where(alive & ~lost, task.reward(seen, action).numpy(), 0.0)
        lengths += alive
        fallen |= alive & (lost | task.terminated(seen).numpy())
        alive &= ~fallen
        if not alive.any():
            break
    positions, rates = (np.stack(states) for states in zip(*path, strict=True))
    return Motion(positions, rates, returns, lengths, fallen)


def speed(motion: Motion, control_dt: float) -> float:
    """Mean forward speed over all control steps of all episodes, m/s."""
    ends = np.take_along_axis(motion.qpos[..., 0], motion.lengths[None], 0)[0]
    return float((ends - motion.qpos[0, :, 0]).sum() / (control_dt * motion.lengths.sum()))


def feet(scene: Scene) -> list[Flags]:
    """Which of the contact spheres (nc,) are of each foot: a body at the end of a limb, which carries no other."""
    body, parents = worlds.contact_bodies(scene), scene.mj_model.body_parentid
    return [body == k for k in np.unique(body) if k not in parents and parents[k]]


def measure(motion: Motion, scene: Scene, control_dt: float) -> dict[str, object]:
    """The csv's columns of one motion; empty ones where there is no ground, or no foot on it."""
    row: dict[str, object] = {
        "return": float(np.median(motion.returns)),
        "speed": speed(motion, control_dt) if travels(scene) else "",
        "whole": float((~motion.fallen).mean()),
    }
    names = ("penetration", "penetration 95 %", "slip")
    if "contact" not in scene.features:
        return row | dict.fromkeys(names, "")
    frames = np.arange(1, len(motion.qpos))[:, None] <= motion.lengths  # of the states after each step
    depth, slip = worlds.contacts(scene, motion.qpos[1:][frames], motion.qvel[1:][frames])
    limbs = feet(scene)
    deepest = np.concatenate([depth[:, foot].max(1) for foot in limbs])
    own = np.any(limbs, 0)
    within = depth[:, own] > 0
    if not within.any():
        return row | dict.fromkeys(names, "")
    middle, most = np.percentile(1e3 * deepest[deepest > 0], (50, 95))
    return row | dict(zip(names, (float(middle), float(most), float(np.median(slip[:, own][within]))), strict=True))


def conditions(case: Case, args: Args) -> Iterator[tuple[str, World]]:
    """The worlds, by the names that the csv gives them."""
    env, scene, n = case.env, case.env.scene, case.env.num_envs
    yield "here", worlds.Here(env.sim)
    if args.control:
        finer = Integration("semi_implicit", args.finer * env.task.substeps)
        yield "finer", worlds.Here(Simulator(scene, n, finer, env.control_dt, device=env.device))
        yield "control", worlds.Control(scene, n, env.control_dt, finer.substeps)
    for friction in args.friction if scene.ncontact else (1.0,):
        yield f"MuJoCo x{friction:g}", worlds.MuJoCo(scene, n, env.control_dt, friction)


def compare(case: Case, args: Args) -> dict[str, Motion]:
    """The motions of one policy by their worlds; each is in the csv as soon as it is measured."""
    env, saved = case.env, case.saved
    env.reset(seed=SEED)
    qpos, qvel = (state.double().numpy(force=True) for state in (env.qpos, env.qvel))
    task, motions, own = type(env.task)(dtype=torch.float64), dict[str, Motion](), math.nan
    integration = env.sim.integration
    about = case.about | {"integrator": integration.integrator, "substeps": integration.substeps}
    for name, world in conditions(case, args):
        began = time.perf_counter()
        motions[name] = act(world, task, saved.network, qpos, qvel, env.scene.nu, args.steps)
        found = measure(motions[name], env.scene, env.control_dt)
        if isinstance(value := found["speed"], float):
            own = value if name == "here" else own
            found["kept"] = value / own
        asked = {column: getattr(args, column) for column in ("episodes", "steps", "finer")}
        row = about | {"condition": name, **found, **asked, "seconds": time.perf_counter() - began}
        args.merge("transfer", [row], KEY)
        print("  " + ", ".join(f"{k} {digits(v)}" for k, v in row.items() if k not in about), flush=True)
    return motions


# What is shown --------------------------------------------------------------------------------------------------------


def table(rows: list[dict[str, str]]) -> str:
    """A line for each task, contact and learner, over its seeds: medians of the speed in each world in m/s, or of the
    return of a robot that does not travel, mean shares of whole episodes in MuJoCo, medians of the feet's penetration.

    Runs that are not named {learner}/{task}__{seed} have a line each.
    """
    groups = dict[tuple[str, ...], dict[str, list[dict[str, str]]]]()
    tasks = [*diffsim.TASKS]
    for row in sorted(rows, key=lambda row: (tasks.index(row["task"]), row["contact"] != "soft")):
        folder, _, run = row["checkpoint"].rpartition("/")
        learner = folder if run == f"{row['task']}__{row['seed']}" else row["checkpoint"]
        key = row["task"], row["contact"], learner
        groups.setdefault(key, {}).setdefault(row["condition"], []).append(row)
    names = {name for group in groups.values() for name in group if name.startswith("MuJoCo")}
    order = sorted(names, key=lambda name: float(name.partition("x")[2]))
    lines = list[Row]()

    def middle(found: list[dict[str, str]], column: str, form: str) -> str:
        values = [float(row[column]) for row in found if row[column]]
        return format(median(values), form) if values else ""

    for (task, contact, learner), group in groups.items():
        seeds = len(group["here"])
        line = {"task": task, "contact": contact, "learner": learner, "seeds": seeds}
        unit = ("speed", ".2f") if group["here"][0]["speed"] else ("return", ".0f")
        line |= {name: middle(group.get(name, []), *unit) for name in ("here", *order)}
        there = group.get("MuJoCo x1", [])
        kept = [float(row["kept"]) for row in there if row["kept"]]
        line |= {"kept": f"{median(kept):.0%}" if kept else "", "worst": f"{min(kept):.0%}" if kept else ""}
        own = {row["seed"]: float(row[unit[0]]) for row in group["here"]}
        errors = [abs(float(row[unit[0]]) - own[row["seed"]]) for row in group.get("control", [])]
        line["control off by"] = format(max(errors), unit[1]) if errors else ""
        shares = [mean(float(row["whole"]) for row in group[name]) for name in order if name in group]
        line["whole"] = " / ".join(f"{share:.0%}" for share in shares)
        line |= {f"depth {name}": middle(group.get(name, []), "penetration", ".1f") for name in ("here", "MuJoCo x1")}
        lines.append(line)
    return markdown(lines)


def median_episode(motion: Motion) -> int:
    return int(motion.returns.argsort()[(len(motion.returns) - 1) // 2])


def film(path: Path, env: DiffEnv, here: Motion, there: Motion) -> None:
    """The same start here (left) and there (right); who has fallen stays as it fell."""
    episode, stride = median_episode(here), max(1, math.ceil(1 / (render.VIDEO_FPS * env.control_dt) - 1e-6))
    renderer = partial(render.Renderer, env.scene, *render.VIDEO_SIZE)
    ends = [motion.lengths[episode] for motion in (here, there)]
    count = min(max(ends), round(render.VIDEO_SECONDS / env.control_dt))
    with renderer() as left, renderer() as right:
        frames = (
            np.concatenate(
                [
                    side.draw(motion.qpos[min(k, end), episode])
                    for side, motion, end in zip((left, right), (here, there), ends, strict=True)
                ],
                1,
            )
            for k in range(0, count, stride)
        )
        print(render.save_video(path, frames, 1 / (stride * env.control_dt)))


def panels(label: str, env: DiffEnv, motions: dict[str, Motion]) -> list[Panel]:
    """Speed and penetration of the deepest foot against time, in the episode of median return here."""
    episode, lines = median_episode(motions["here"]), (list[Line](), list[Line]())
    own = np.any(feet(env.scene), 0)
    for name, style in STYLES.items():
        motion = motions[name]
        end = min(int(motion.lengths[episode]), round(SHOWN / env.control_dt)) + 1
        qpos, qvel = motion.qpos[:end, episode], motion.qvel[:end, episode]
        depth, _ = worlds.contacts(env.scene, qpos, qvel)
        seconds = env.control_dt * np.arange(end)
        for side, y in zip(lines, (qvel[:, 0], 1e3 * depth[:, own].max(1).clip(0)), strict=True):
            side.append(Line(seconds, y, style, name, 0.8))
    return [
        Panel(lines[0], label, "s", "forward velocity (m/s)"),
        Panel(lines[1], label, "s", "deepest foot below ground (mm)", zero=True),
    ]


def main(args: Args) -> None:
    paths = args.measured
    if args.video:
        if len(args.checkpoints) != 1:
            fail("--video shows one checkpoint")
        try:
            render.check_video(args.video, (2 * render.VIDEO_SIZE[0], render.VIDEO_SIZE[1]))
            render.check_opengl()
        except (ValueError, RuntimeError) as error:
            fail(f"--video: {error}")
    if (args.video or args.curves) and 1.0 not in args.friction:
        fail("--video and --curves show MuJoCo at the file's friction: give --friction 1 as well")
    grid = list[list[Panel]]()
    for case in [load(path, args) for path in paths]:
        print(f"{case.label}: {case.saved.args['env']}, {case.saved.script}.py", flush=True)
        motions = compare(case, args)
        if args.video:
            film(args.video, case.env, motions["here"], motions["MuJoCo x1"])
        if args.curves and "contact" in case.env.scene.features:
            grid.append(panels(case.label, case.env, motions))
    if grid:
        plot(args.picture("transfer"), grid, (5.0, 2.9))
    args.publish("transfer", table(args.read("transfer")), "transfer.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))

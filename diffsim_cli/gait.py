"""Measure how a robot moves over the ground, as numbers of each foot, and of the robot with its actions."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Scene
from diffsim.robot.types import Array, Index
from diffsim.training.evaluation import Evaluation
from diffsim.training.log import say

EPISODES = 8  # at most as many are measured
SETTLING = 1.0  # s at the start of an episode that are left out
TOUCHING = 0.03  # a body that touches the ground in a smaller share of the frames is no foot
BOUNCE = 0.05  # s; a foot that leaves the ground for no longer has not made a step
END = 0.99  # of half its range, beyond which an action is saturated
FOOT = "duty", "steps/s", "clearance (m)", "slip (m/s)", "depth (m)"  # docs/running.md says what each is
ROBOT = "left-right", "diagonal", "action change", "saturated", "cost of transport"
Gait = dict[str, dict[str, float]]  # those of each foot by its body's name, and of the "robot"


def of_evaluation(evaluation: Evaluation) -> Gait:
    """Measure the episodes of an evaluation."""
    episodes = map(evaluation.episode, range(len(evaluation.returns)))
    return measure(evaluation.scene, evaluation.control_dt, episodes)


def report(evaluation: Evaluation, directory: Path) -> None:
    """Print `lines`, and leave all numbers in gait.csv."""
    if numbers := of_evaluation(evaluation):
        if shown := lines(numbers):
            say("\n".join(shown))
        rows = [(part, name, value) for part, values in numbers.items() for name, value in values.items()]
        with (directory / "gait.csv").open("w", newline="") as file:
            csv.writer(file).writerows([("part", "number", "value"), *rows])


def lines(gait: Gait) -> list[str]:
    """Write a line for each foot that steps, and one for the robot; nothing of what only lies or slides."""
    feet = {part: numbers for part, numbers in gait.items() if numbers.get("steps/s", 0.0) > 0}
    robot = {name: value for name, value in gait.get("robot", {}).items() if name != "diagonal" or len(feet) == 4}
    shown = feet | {"robot": robot} if feet and robot else feet
    texts = (", ".join(f"{name} {value:.3g}" for name, value in numbers.items()) for numbers in shown.values())
    return [f"{part:16}  {text}" for part, text in zip(shown, texts, strict=True)]


def contact_bodies(scene: Scene) -> Index:
    """Return MuJoCo's number of the body (ncontact,) of each contact sphere."""
    return scene.mj_model.dof_bodyid[scene.contact_link + (5 if scene.floating else -1)]  # a link's last dof


def trace(scene: Scene, qpos: Array) -> tuple[Array, Array]:
    """Compute depth (F, nc) and slip (F - 1, nc) [m] of the contact spheres' lowest points for qpos (F, nq)."""
    model, data, bodies = scene.mj_model, mujoco.MjData(scene.mj_model), contact_bodies(scene)
    # A link's frame has the axes of its body and sits at the anchor of its joint.
    centre = model.jnt_pos[model.body_jntadr[bodies] + model.body_jntnum[bodies] - 1] + scene.contact_position
    place, turn = np.empty((len(qpos), len(bodies), 3)), np.empty((len(qpos), len(bodies), 3, 3))
    for k, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        place[k], turn[k] = data.xpos[bodies], data.xmat[bodies].reshape(-1, 3, 3)
    lowest = centre - scene.contact_radius[:, None] * turn[:, :, 2]  # in the body's frame
    point = place + np.einsum("fcij,fcj->fci", turn, lowest)
    moved = place[1:] + np.einsum("fcij,fcj->fci", turn[1:], lowest[:-1]) - point[:-1]
    return scene.ground_height - point[..., 2], np.linalg.norm(moved[..., :2], axis=-1)


def work(scene: Scene, dt: float, qpos: Array, action: Array) -> float:
    """J that the motors do, without what they absorb, over the robot's weight: m."""
    model, data, done = scene.mj_model, mujoco.MjData(scene.mj_model), 0.0
    low, high = model.actuator_ctrlrange.T
    for now, then, ctrl in zip(qpos, qpos[1:], (low + high + (high - low) * action.clip(-1, 1)) / 2, strict=False):
        mujoco.mj_differentiatePos(model, data.qvel, dt, now, then)
        data.qpos[:], data.ctrl[:] = now, ctrl
        mujoco.mj_forward(model, data)
        done += float((data.qfrc_actuator * data.qvel).clip(0).sum()) * dt
    return done / (9.81 * model.body_mass.sum())


def measure(scene: Scene, dt: float, episodes: Iterable[tuple[NDArray[Any], NDArray[Any]]]) -> Gait:
    """Measure episodes of qpos (F, nq) and action (F, nu); empty without contact with a plane or if all are short."""
    first, feet = round(SETTLING / dt), Gait()
    settled = [(q[first:], a[first:]) for q, a in islice(episodes, EPISODES) if len(q) > first + 1]
    if "contact" not in scene.features or scene.terrain is not None or not settled:
        return {}
    traces, bodies, sides = [trace(scene, qpos) for qpos, _ in settled], contact_bodies(scene), list[Array]()
    mujoco.mj_kinematics(scene.mj_model, data := mujoco.MjData(scene.mj_model))
    for body in np.unique(bodies):
        depths, slides = ([kind[:, bodies == body] for kind in kinds] for kinds in zip(*traces, strict=True))
        deepest = [depth.max(1) for depth in depths]
        contact = (joined := np.concatenate(deepest)) > 0
        if contact.mean() < TOUCHING:
            continue
        landings = [touch_downs(depth, dt) for depth in deepest]
        peaks = [-depth[a:b].min() for depth, ends in zip(deepest, landings, strict=True) for a, b in pairwise(ends)]
        slid = np.concatenate([s[(d[1:] > 0) & (d[:-1] > 0)] for d, s in zip(depths, slides, strict=True)])
        steps, slip = sum(map(len, landings)) / (len(contact) * dt), slid.sum() / max(len(slid), 1) / dt
        numbers = contact.mean(), steps, np.median(peaks or 0.0), slip, np.median(joined[contact])
        feet[scene.mj_model.body(body).name] = dict(zip(FOOT, map(float, numbers), strict=True))
        sides.append(np.sign(data.xipos[body, :2].round(6)))
    if not feet:
        return {}
    duty, (x, y) = np.array([foot["duty"] for foot in feet.values()]), np.array(sides).T
    unlike = [2 * abs(np.mean(duty * side)) for side in (y, x * y * (len(feet) == 4))]
    changes, ends = np.concatenate([[np.diff(a, axis=0), np.abs(a[1:]) > END] for _, a in settled], axis=1)
    second = min(round(1 / dt), *(len(q) - 1 for q, _ in settled))
    way = sum(len(q) / second * np.linalg.norm(q[second:, :2] - q[:-second, :2], axis=1).mean() for q, _ in settled)
    cost = sum(work(scene, dt, *episode) for episode in settled) / max(way, 1e-9)
    robot = map(float, (*unlike, np.sqrt(np.mean(changes**2)), ends.mean(), cost))
    return feet | {"robot": dict(zip(ROBOT, robot, strict=True))}


def touch_downs(depth: Array, dt: float) -> list[int]:
    """Frames in which a foot lands after more than BOUNCE seconds in the air; depth (F,), dt in s."""
    down = np.flatnonzero(depth > 0)
    return down[np.diff(down, prepend=-1) - 1 > BOUNCE / dt + 1e-6].tolist()

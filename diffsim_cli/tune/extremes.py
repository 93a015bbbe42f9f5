"""Measure how far a robot can be driven: masses, stiffness, speeds, drops and time steps at which integrators fail."""

from __future__ import annotations

import copy
import dataclasses
import math

import mujoco
import numpy as np
import torch
from tqdm import tqdm

from diffsim.robot.mjcf import load_scene
from diffsim.sim.integration import Integration
from diffsim.tasks import Task
from diffsim_cli.tune.front import integrator
from diffsim_cli.tune.motion import Motion

FINER = 16  # the reference's substeps, in multiples of the default's
LARGE = (10.0, 100.0, 1000.0)
SWEEPS: dict[str, tuple[float, ...]] = {
    "substeps": (24, 16, 12, 8, 6, 4, 3, 2, 1),
    "contact stiffness x": LARGE,
    "last body's mass x": (*LARGE, 10_000),
    "last body's mass /": (*LARGE, 10_000),
    "speed of the root (m/s)": LARGE,
    "speed of a joint (1/s)": LARGE,
    "drop (m)": (1, 10, 100),
}


def stress(motion: Motion, task: type[Task], contact: str) -> list[dict[str, str]]:
    """Find the first value of each sweep with which an integrator, at the task's default substeps, fails within 0.5 s.

    It fails where an environment is contained, or its kinetic energy passes twice the largest of a float64 reference.
    """
    how = task.integration("default", contact)
    both = (how, how._replace(implicit=True)) if contact == "soft" else (how,)
    kinds = {integrator(each): each for each in both}
    grounded = "contact" in motion.scene.features
    sweeps = [sweep for sweep in SWEEPS if grounded or sweep not in ("contact stiffness x", "drop (m)")]
    return [
        {"sweep": sweep} | {kind: first_failure(motion, sweep, how) for kind, how in kinds.items()}
        for sweep in tqdm(sweeps, "extremes", leave=False, ncols=80)
    ]


def first_failure(motion: Motion, sweep: str, how: Integration) -> str:
    """The value and how it fails; "-" if no value of the sweep does."""
    for value in SWEEPS[sweep]:
        case, own = extreme(motion, sweep, value), how
        if sweep == "substeps":
            if value >= how.substeps:
                continue
            own = how._replace(substeps=int(value))
        trail = case.replay(own)
        if trail.contained:
            return f"{value:g} (not finite)"
        finest = case.replay(how._replace(substeps=FINER * how.substeps), torch.float64)
        if case.energies(trail).max() > 2 * case.energies(finest).max():
            return f"{value:g} (energy)"
    return "-"


def extreme(motion: Motion, sweep: str, value: float) -> Motion:
    """The motion with one quantity at an extreme."""
    case, model = copy.copy(motion), copy.deepcopy(motion.scene.mj_model)
    match sweep:
        case "last body's mass x" | "last body's mass /":
            factor = value if sweep.endswith("x") else 1 / value
            model.body_mass[-1] *= factor
            model.body_inertia[-1] *= factor
            mujoco.mj_setConst(model, mujoco.MjData(model))
            case.scene = load_scene(model)
        case "contact stiffness x":
            model.geom_solref[:, 0] *= np.where(model.geom_solref[:, 0] > 0, value**-0.5, value)
            soft = not math.isnan(motion.scene.k_n)
            case.scene = load_scene(model).with_penalty({"k_n": value * motion.scene.k_n} if soft else {})
        case "speed of the root (m/s)":
            case.qvel = case.qvel.index_fill(1, torch.tensor(0), value)
        case "speed of a joint (1/s)":
            case.qvel = case.qvel.index_fill(1, torch.tensor(case.scene.nv - 1), value)
        case "drop (m)":
            case.qpos = case.qpos.clone()
            case.qpos[:, 2 if case.scene.floating else 1] += value
    case.scene = dataclasses.replace(case.scene, geom_pairs=motion.scene.geom_pairs)
    return case

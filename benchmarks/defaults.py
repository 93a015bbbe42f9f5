"""How well the default constants of contact and limits follow MuJoCo on gymnasium's robots.

From states that MuJoCo visits under random controls, both simulators take 0.1 s. The error is the difference in
velocity, in the norm of the kinetic energy: its mean over the states, relative to the mean speed. In MuJoCo the robots'
parts pass through each other too, and margins are 0. `python benchmarks/defaults.py` writes defaults.csv.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from common import OUTPUT, RESULTS
from numpy.typing import NDArray
from tables import write_csv

from diffsim import Integration, Scene, Simulator, load_scene

Array = NDArray[np.float64]

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
ROBOTS = ("ant", "half_cheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum", "reacher", "walker2d_v5")
FORMER = {"k_n": 2e4, "k_d": 1e3, "k_t": 1e3, "mu": 0.9, "k_limit": 1e3, "d_limit": 0.0}
STATES, STEPS, EPISODE = 160, 6, 40  # control steps of 1/60 s a segment; segments an episode, the first two are skipped


class Segments(NamedTuple):
    """Of MuJoCo's motion: (STATES, ...) state, control, velocity after the segment and mass matrix there."""

    qpos: Array
    qvel: Array
    ctrl: Array
    after: Array
    matrix: Array


def segments(name: str, seed: int = 0) -> Segments:
    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.timestep, model.opt.integrator = 1 / 1920, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    fixed = model.body_weldid[model.geom_bodyid] == 0
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    model.geom_contype[:], model.geom_conaffinity[:] = touches & ~fixed, touches & fixed
    model.geom_margin[:], model.jnt_margin[:] = 0, 0
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    (low, high), count = model.actuator_ctrlrange.T, 0
    rows = list[tuple[Array, ...]]()
    while len(rows) < STATES:
        if count % EPISODE == 0:
            mujoco.mj_resetData(model, data)
            for joint in np.flatnonzero(model.jnt_limited):
                data.qpos[model.jnt_qposadr[joint]] = rng.uniform(*model.jnt_range[joint])
        count += 1
        ctrl = rng.uniform(-1, 1, model.nu)
        data.ctrl[:] = (low + high) / 2 + (high - low) / 2 * ctrl
        before = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(model, data, nstep=32 * STEPS)
        matrix = np.eye(model.nv)
        for row, unit in zip(matrix, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        if count % EPISODE > 2:
            rows.append((*before, ctrl, data.qvel.copy(), matrix))
    return Segments(*(np.array(column) for column in zip(*rows, strict=True)))


@torch.no_grad()
def error(scene: Scene, motion: Segments) -> float:
    sim = Simulator(scene, STATES, Integration(substeps=32))
    qpos, qvel, ctrl = (torch.tensor(x, dtype=torch.float32) for x in motion[:3])
    for _ in range(STEPS):
        qpos, qvel = sim.step(qpos, qvel, ctrl)

    def norm(velocity: Array) -> Array:
        result: Array = np.sqrt(np.einsum("ni,nij,nj->n", velocity, motion.matrix, velocity))
        return result

    return float(norm(qvel.double().numpy() - motion.after).mean() / norm(motion.after).mean())


def firmer(scene: Scene, factor: float) -> Scene:
    constants = ("k_n", "k_d", "k_limit", "d_limit")
    return dataclasses.replace(scene, **{name: factor * getattr(scene, name) for name in constants})


def one_limit(scene: Scene) -> Scene:
    """With the geometric mean of the limits' constants at every joint."""
    limited = scene.k_limit > 0
    means = {name: float(np.exp(np.log(getattr(scene, name)[limited]).mean())) for name in ("k_limit", "d_limit")}
    return scene.with_penalty(means)


@dataclass
class Args:
    update_results: bool = False  # write to results/ of this repository instead of runs/benchmarks/


def main(args: Args) -> None:
    rows = []
    for name in ROBOTS:
        scene, motion = load_scene(ASSETS / f"{name}.xml"), segments(name)
        scenes = {
            "default": scene,
            "half as firm": firmer(scene, 0.5),
            "twice as firm": firmer(scene, 2.0),
            "one limit for all joints": one_limit(scene),
            "fixed constants": scene.with_penalty(FORMER),
        }
        rows.append({"robot": name} | {what: f"{error(one, motion):.3f}" for what, one in scenes.items()})
        print(rows[-1], flush=True)
    write_csv((RESULTS if args.update_results else OUTPUT) / "cpu" / "defaults.csv", rows)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,)))

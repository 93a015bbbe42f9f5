"""Robots that other people made: which MJCF files of a folder load, and how far the accelerations are from MuJoCo's.

python benchmarks/foreign.py path/to/mujoco_menagerie               kernels of each robot are compiled: some 10 s each
python benchmarks/foreign.py path/to/mujoco_menagerie --states 0    what loads and what is refused alone

The robots fly: contact, limits and dry friction are constraints in MuJoCo, and are left out on both sides.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro
from common import TASKS, CommonFlags, Tasks, run

from diffsim import SceneError, Simulator, load_scene
from diffsim.robot.scene import Scene
from diffsim.sim.integration import Integration
from diffsim.training import fail

STEP = 2.0**-10  # s: no acceleration reaches the speed at which a simulator contains a state


@dataclass
class Args(CommonFlags):
    folder: tyro.conf.Positional[Path] = Path()  # where the files are
    pattern: str = "*/scene*.xml"  # which of its files
    states: int = 200  # random states of each robot whose accelerations are compared; 0 for none
    env: tyro.conf.Suppress[Tasks] = TASKS
    draw_only: tyro.conf.Suppress[bool] = False  # there is nothing to draw


def random_states(scene: Scene, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """qpos within the joints' limits, or half a turn or metre about zero; qvel, ctrl."""
    m = scene.mj_model
    qpos = rng.normal(size=(count, m.nq))  # of the free joint, and of ball joints
    scalar = np.flatnonzero(m.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
    low, high = np.where(m.jnt_limited[scalar, None], m.jnt_range[scalar], (-0.5, 0.5)).T
    qpos[:, m.jnt_qposadr[scalar]] = rng.uniform(low, high, (count, len(scalar)))
    for at in scene.quaternion_adr:
        qpos[:, at : at + 4] /= np.linalg.norm(qpos[:, at : at + 4], axis=1, keepdims=True)
    return qpos, rng.normal(size=(count, m.nv)), rng.uniform(-1, 1, (count, m.nu))


def difference(scene: Scene, count: int) -> float:
    """Largest error of an acceleration, relative to the largest one of its state."""
    m = copy.copy(scene.mj_model)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    states = random_states(scene, count, np.random.default_rng(1))
    scene = load_scene(m)
    sim = Simulator(scene, count, Integration(substeps=1), control_dt=STEP, dtype=torch.float64)
    qpos, qvel, ctrl = (torch.tensor(x) for x in states)
    with torch.no_grad():
        qacc = (sim.step(qpos, qvel, ctrl)[1] - qvel).numpy() / STEP
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, (-1.0, 1.0)).T
    data, errors = mujoco.MjData(m), []
    for *state, value in zip(*states, qacc, strict=True):
        data.qpos, data.qvel, data.ctrl = state[0], state[1], low + (state[2] + 1) / 2 * (high - low)
        mujoco.mj_forward(m, data)
        errors.append(abs(value - data.qacc).max() / abs(data.qacc).max())
    return float(np.max(errors)) if not sim.nonfinite.any() else np.inf  # nan if one is


def main(args: Args) -> None:
    folder, found = args.folder.resolve(), list[bool]()  # meshes may lie beside the folder
    for path in sorted(folder.glob(args.pattern)) or fail(f"{folder} has no {args.pattern}"):
        row: dict[str, object] = {"collection": folder.name, "file": path.relative_to(folder).as_posix()}
        try:
            scene = load_scene(path)
            row |= {"refused": "", "nq": scene.nq, "nv": scene.nv, "nu": scene.nu, "contact points": scene.ncontact}
            row["relative error of qacc"] = difference(scene, args.states) if args.states else ""
        except SceneError as error:
            row["refused"] = " ".join(str(error).removeprefix(f"{path.name}: ").split("\n")[:2])
        found.append(not row["refused"])
        args.keep("foreign", row, ("collection", "file"))
    print(f"{sum(found)} of {len(found)} load: {args.csv('foreign')}")


if __name__ == "__main__":
    run(main, Args, __doc__)

"""Robots that other people made: which MJCF files of a folder load, and how far their motion is from MuJoCo's.

python benchmarks/foreign.py path/to/mujoco_menagerie               kernels of each robot are compiled: some 20 s each
python benchmarks/foreign.py path/to/mujoco_menagerie --states 0    what loads and what is refused alone

`qacc` compares accelerations in flight, where contact, limits and dry friction are left out on both sides. `step`
compares a step of the file as it stands: its timestep, cone, integrator, contact, limits and friction.
"""

from __future__ import annotations

import copy
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, cycle, islice
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro
from common import TASKS, CommonFlags, Tasks, run

from diffsim import SceneError, Simulator, load_scene
from diffsim.robot.contacts import ground_pairs
from diffsim.robot.elements import control_range
from diffsim.robot.pairs import touching
from diffsim.robot.scene import Scene
from diffsim.robot.shapes import as_primitives
from diffsim.robot.types import Array
from diffsim.sim.integration import Integration
from diffsim.training import fail
from diffsim_cli.gait import trace
from diffsim_cli.report import ROUGH_SHAPES, approximations

STEP = 2.0**-10  # s: no acceleration reaches the speed at which a simulator contains a state
EQUAL = 1e-6  # relative error below which a step counts as MuJoCo's
STEPS, DRAWS = 32, 400  # steps that are compared of each robot, at most, and states that are drawn
# Sentences of the report that tell no difference of the steps compared here
HARMLESS = "The robot's parts", "A control of", "Action 0"
TETRAHEDRON = [0.0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]


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


def read(path: Path) -> tuple[Scene, int]:
    """Load a file, and count its meshes whose files are absent: if they are only drawn, others are in their place.

    Raises:
        SceneError: it cannot be simulated.
    """
    near, stand_ins = {file.name for file in path.parent.rglob("*")}, 0
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for mesh in spec.meshes:
            shows = [geom for geom in spec.geoms if geom.meshname == mesh.name]
            drawn = all(not (g.contype or g.conaffinity) and (g.parent.explicitinertial or g.mass == 0) for g in shows)
            there = Path(mesh.file).name in near or (path.parent / spec.meshdir / mesh.file).exists()
            if mesh.file and not there and drawn:
                mesh.name, mesh.file, mesh.uservert = mesh.name or Path(mesh.file).stem, "", TETRAHEDRON
                stand_ins += 1
        return load_scene(spec), stand_ins
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"{path.name}: {' '.join(str(error).split())}") from error


def differences(ours: Array, theirs: Array) -> Array:
    """Largest error in each row, relative to its largest number."""
    return abs(ours - theirs).max(1) / abs(theirs).max(1)


def flight_error(m: mujoco.MjModel, count: int) -> float:
    """Largest error of an acceleration without constraints, relative to the largest one of its state."""
    m = copy.copy(m)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    scene = load_scene(m)
    qpos, qvel, ctrl = random_states(scene, count, np.random.default_rng(1))
    qacc = take_step(scene, Integration(substeps=1), STEP, qpos, qvel, ctrl) / STEP
    data, (low, high), expected = mujoco.MjData(m), control_range(m), []
    for state in zip(qpos, qvel, low + (ctrl + 1) / 2 * (high - low), strict=True):
        data.qpos, data.qvel, data.ctrl = state
        mujoco.mj_forward(m, data)
        expected.append(data.qacc.copy())
    return float(differences(qacc, np.array(expected)).max())


def take_step(scene: Scene, integration: Integration, seconds: float, *states: Array) -> Array:
    """Return the changes of velocity (count, nv) in a step; nan of a state that is contained."""
    sim = Simulator(scene, len(states[0]), integration, control_dt=seconds, dtype=torch.float64)
    qpos, qvel, ctrl = (torch.tensor(x) for x in states)
    with torch.no_grad():
        change = (sim.step(qpos, qvel, ctrl)[1] - qvel).numpy()
    change[sim.nonfinite.numpy()] = np.nan
    return change


def states_near_ground(scene: Scene) -> Iterator[tuple[Array, Array, Array]]:
    """Yield qpos, qvel, ctrl near the first keyframe or the reference pose: of a robot that can be lifted the lowest
    point is up to 2 mm in the ground, or in every second state 50 mm above it.
    """
    m, rng = scene.mj_model, np.random.default_rng(2)
    for height in cycle((0.0, 0.05)):
        qpos = (m.key_qpos[0] if m.nkey else m.qpos0).copy()
        mujoco.mj_integratePos(m, qpos, rng.uniform(0, 0.3) * rng.normal(size=m.nv), 1.0)
        depth = rng.uniform(0, 0.002)
        if scene.ncontact:
            qpos += scene.root.up * (trace(scene, qpos[None])[0].max() + (height or -depth))
        yield qpos, 0.3 * rng.normal(size=m.nv), rng.uniform(-1, 1, m.nu)


def step_errors(scene: Scene) -> dict[str, object]:
    """Compare steps with MuJoCo's.

    Returns:
        step: largest error of at most STEPS states, `with contact` of some of them, in which no geoms touch that do not
            here (`self-contact` counts those) and no contact is one that the report tells about.
        converged: the same, of MuJoCo's step with a solver that goes on until it converges.
        step of told contacts: median error of at most STEPS states with contact of rough shapes or condim 4 or 6.
    """
    m, (low, high) = scene.mj_model, control_range(scene.mj_model)
    patient, simple, contacts, clashes = copy.copy(m), as_primitives(m), 0, 0
    between = {*scene.geom_pairs}
    ours = between | {(min(pair), max(pair)) for pair in ground_pairs(m)}
    patient.opt.solver, patient.opt.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 0
    patient.opt.iterations, patient.opt.ls_iterations = 100, 50
    data, long, inside = mujoco.MjData(m), mujoco.MjData(patient), mujoco.MjData(simple)
    exact, told = list[tuple[Array, ...]](), list[tuple[Array, ...]]()
    for qpos, qvel, ctrl in islice(states_near_ground(scene), DRAWS):
        for model, its in ((m, data), (patient, long)):
            mujoco.mj_resetData(model, its)
            its.qpos, its.qvel, its.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
            mujoco.mj_step(model, its)
        inside.qpos, changes = qpos, (data.qvel - qvel, long.qvel - qvel)
        mujoco.mj_fwdPosition(simple, inside)
        found, stand_ins = touching(data), touching(inside) & between
        rough = np.isin(m.geom_type[[*chain.from_iterable(found | stand_ins)]], list(ROUGH_SHAPES)).any()
        if found - ours:
            clashes += 1
        elif rough or (data.contact.dim > 3).any():
            told.append((qpos, qvel, ctrl, *changes))
        elif len(exact) < STEPS:
            exact.append((qpos, qvel, ctrl, *changes))
            contacts += len(found) > 0
    row: dict[str, object] = {"step": "", "converged": "", "states": len(exact), "with contact": contacts}
    row |= {"self-contact": clashes, "step of told contacts": ""}
    integration = Integration("mujoco", substeps=1, tolerance=1e-12)
    for kept, summary, names in (
        (exact, np.max, ("step", "converged")),
        (told[:STEPS], np.median, ("step of told contacts",)),
    ):
        if kept:
            *states, first, second = map(np.array, zip(*kept, strict=True))
            change = take_step(scene, integration, m.opt.timestep, *states)
            for name, theirs in zip(names, (first, second), strict=False):
                row[name] = float(summary(differences(change, theirs)))
    return row


def outcome(row: dict[str, object]) -> str:
    """Sum up a row: refused, loaded (nothing is compared), equal with or without contact, equal only if MuJoCo's
    solver converges, or else whether the report tells why.
    """
    if row["refused"] or not row.get("step"):
        return "refused" if row["refused"] else "loaded"
    if float(str(row["step"])) < EQUAL:
        return "equal with contact" if row["with contact"] else "equal without contact"
    if float(str(row["converged"])) < EQUAL:
        return "equal if converged"
    return "told" if row["told"] else "silent"


def main(args: Args) -> None:
    folder, collection = args.folder.resolve(), args.folder.absolute().name  # meshes may lie beside the folder
    rows, robots = list[dict[str, object]](), defaultdict[str, list[str]](list)
    for path in sorted(folder.glob(args.pattern)) or fail(f"{folder} has no {args.pattern}"):
        file = path.relative_to(folder)
        row: dict[str, object] = {"collection": collection, "file": file.as_posix(), "refused": ""}
        try:
            scene, row["absent meshes"] = read(path)
            row |= {"nq": scene.nq, "nv": scene.nv, "nu": scene.nu, "contact points": scene.ncontact}
            row["told"] = " ".join(each for each in approximations(scene) if not each.startswith(HARMLESS))
            if args.states:
                row["relative error of qacc"] = flight_error(scene.mj_model, args.states)
                row |= step_errors(scene)
        except SceneError as error:
            lines = str(error).partition(": ")[2].replace(f"{path.parent}/", "").split("\n  ")
            row["refused"] = " ".join(lines[:2])
            for line in lines[len(lines) > 1 :]:
                robots[f"{line.split()[0]}: {line.rpartition(': ')[2]}"].append(file.parts[0])
        row["outcome"] = outcome(row)
        rows.append(row)
        args.keep("foreign", row, ("collection", "file"))
    for reason, refused in robots.items():
        print(f"{len(refused)} refused, {reason} ({', '.join(dict.fromkeys(refused))})")
    counts = Counter(row["outcome"] for row in rows)
    print(f"{len(rows)} files: {', '.join(f'{number} {word}' for word, number in counts.items())}")


if __name__ == "__main__":
    run(main, Args, __doc__)

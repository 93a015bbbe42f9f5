"""Report how the simulator reads an MJCF file: `python -m diffsim check robot.xml`"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import mujoco
import numpy as np
import torch
import warp as wp

from diffsim.robot import types
from diffsim.robot.contacts import (
    HULL_POINTS,
    base_geoms,
    contact_points,
    ground_pairs,
    matrix_of,
    pair_law,
)
from diffsim.robot.elements import control_range, label, listed, motors, muscles, servos
from diffsim.robot.pairs import first_contacts, self_pairs
from diffsim.robot.scene import Scene
from diffsim.robot.shapes import as_primitives, deviation, directions, is_exact, obstacle_geoms, reach
from diffsim.robot.types import Array
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks.own_task import start_control
from diffsim_cli.gait import trace

Kind, Geom, Integrator = mujoco.mjtObj, mujoco.mjtGeom, mujoco.mjtIntegrator

# How a geom's points stand for it, by its type
ROUGH_SHAPES = {
    int(Geom.mjGEOM_CYLINDER): "8 of each rim of a cylinder",
    int(Geom.mjGEOM_ELLIPSOID): "14 of an ellipsoid's surface",
    int(Geom.mjGEOM_MESH): f"at most {HULL_POINTS} corners of a mesh's convex hull",
}
# Integrators that are not simulated, and which one is in their place
REPLACED = {
    int(Integrator.mjINT_RK4): (Integrator.mjINT_EULER, "integrator RK4, simulated as Euler"),
    int(Integrator.mjINT_IMPLICIT): (Integrator.mjINT_IMPLICITFAST, "integrator implicit, simulated as implicitfast"),
}
STARTS = 12  # motions of which steps are compared
LEAST_ERROR = 0.01  # %, that is told


def report(scene: Scene) -> str:
    """Return a page of text about a scene."""
    sections = [
        (f"{scene.name}: can be simulated", list(_parts(scene))),
        ("approximated", [f"- {sentence}" for sentence in approximations(scene)]),
    ]
    return "\n\n".join("\n  ".join([title, *lines]) for title, lines in sections if lines)


def _parts(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    kinds = sorted((name.removeprefix("mjJNT_").lower(), kind) for name, kind in mujoco.mjtJoint.__members__.items())
    counts = [f"{n} {name}" for name, kind in kinds if (n := np.count_nonzero(m.jnt_type == kind))]
    pulling = len(np.unique(scene.segment_muscle))
    ground = f"ground at z = {scene.ground_height:g} m" if scene.ncontact else "no ground that it may touch"
    yield f"links      {scene.nlink - 1} of one degree of freedom, base {'floating' if scene.floating else 'fixed'}"
    yield f"joints     {', '.join(counts)}; {np.count_nonzero(np.isfinite(scene.upper))} limited"
    yield f"state      nq {scene.nq}, nv {scene.nv}"
    yield f"mass       {scene.mass.sum():.4g} kg"
    servo, motor = servos(m) & ~muscles(m), motors(m) & ~muscles(m)
    position = servo & (m.actuator_biasprm[:, 1] != 0)
    drives = {"motors": motor, "position servos": position, "velocity servos": servo & ~position}
    found = [f"{n} {kind}" for kind, which in drives.items() if (n := np.count_nonzero(which))]
    yield f"controls   {', '.join(found + [f'{pulling} muscles'] * bool(pulling)) or 'none'}"
    wrong = "" if 0 < m.opt.timestep < np.inf else ", with which MuJoCo cannot step"
    yield f"timestep   {1e3 * m.opt.timestep:g} ms in the file{wrong}; in a task control_dt / substeps"
    pairs = f", {len(scene.geom_pairs)} pairs of geoms" * bool(scene.geom_pairs)
    yield f"contact    {scene.ncontact} points, {ground}{pairs}"
    yield f"features   {', '.join(sorted(scene.features))}"


def approximations(scene: Scene) -> tuple[str, ...]:
    """Return a sentence for each approximation."""
    checks = _bodies, _self_contact, _ground, _actuators, _options
    return tuple(sentence for check in checks for sentence in check(scene))


def _bodies(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    if scene.left_out:
        yield f"Left out, with their actuators: bodies that touch nothing, {listed(map(repr, scene.left_out))}."
    if m.nmocap:
        names = listed(label(m, Kind.mjOBJ_BODY, body) for body in np.flatnonzero(m.body_mocapid >= 0).tolist())
        yield f"Mocap bodies stay where the file has them: {names}."


def _self_contact(scene: Scene) -> Iterator[str]:
    m, fitted, fixed = scene.mj_model, as_primitives(scene.mj_model), obstacle_geoms(scene.mj_model)
    inexact = {geom for pair in scene.geom_pairs for geom in pair if not is_exact(m, *pair)}
    off = {geom: 1e3 * deviation(m, fitted, geom) for geom in inexact if m.geom_type[geom] != fitted.geom_type[geom]}
    order = sorted(off, key=lambda geom: (-off[geom], geom))
    if rough := [geom for geom in order if not fixed[geom]]:
        yield f"Shapes that touch others as capsules: {len(rough)} (surfaces differ by up to {off[rough[0]]:.3g} mm)."
    if rough := [geom for geom in order if fixed[geom]]:
        shapes = [Geom(fitted.geom_type[geom]).name.removeprefix("mjGEOM_").lower() for geom in rough]
        names = [label(m, Kind.mjOBJ_GEOM, geom) for geom in rough]
        words = ["surfaces differ by up to ", *[""] * len(rough)]
        told = [f"{names[k]} as a {shapes[k]} ({words[k]}{off[geom]:.3g} mm)" for k, geom in enumerate(rough)]
        yield f"Fixed geoms touch others as simpler shapes: {listed(told)}."
    if (number := first_contacts(scene)) > types.MOST_ROOM:
        yield f"Of the {number} contacts between bodies at the start only the {types.MOST_ROOM} deepest act."
    there = set(scene.geom_pairs)
    missing = [pair for pair in self_pairs(m) if pair not in there]
    if gone := [pair for pair in missing if fixed[list(pair)].any()]:
        yield f"Left out, because such shapes overlap at the start: contact of {_pairs_of(m, gone)}."
    if pairs := [pair for pair in missing if pair not in set(gone)]:
        yield (
            f"The robot's parts pass through each other: {_pairs_of(m, pairs)}, would collide in MuJoCo."
            + " Geoms of its fixed base are among them." * bool(base_geoms(m)[np.array(pairs)].any())
        )


def _pairs_of(m: mujoco.MjModel, pairs: list[tuple[int, int]]) -> str:
    names = " and ".join(label(m, Kind.mjOBJ_GEOM, geom) for geom in pairs[0])
    return f"{len(pairs)} pairs of geoms, such as {names}" if len(pairs) > 1 else f"the geoms {names}"


def _ground(scene: Scene) -> Iterator[str]:
    m, pairs = scene.mj_model, ground_pairs(scene.mj_model)
    kinds = {int(m.geom_type[geom]) for _, geom in pairs}
    told = []
    for kind, what in ROUGH_SHAPES.items():
        if kind in kinds:
            inside = max(_depth(m, geom) for _, geom in pairs if m.geom_type[geom] == kind)
            told.append(f"{what} (the shape reaches up to {1e3 * inside:.2g} mm beyond)")
    if told:
        yield f"The ground feels these points of a shape: {', '.join(told)}."


def _depth(m: mujoco.MjModel, geom: int) -> float:
    """Return how far [m] a shape reaches beyond its contact points, in the direction where that is farthest."""
    points = m.geom_pos[geom] + contact_points(m, geom)[0] @ matrix_of(m.geom_quat[geom]).T
    return float((reach(m, geom) - (directions() @ points.T).max(1)).max())


def _options(scene: Scene) -> Iterator[str]:
    """Name what MuJoCo's steps have and steps on MuJoCo's constraints have not, and measure how much that is."""
    m, other = scene.mj_model, copy.copy(scene.mj_model)
    other.opt.integrator, *found = REPLACED.get(m.opt.integrator, [m.opt.integrator])
    other.opt.noslip_iterations, other.opt.solver = 0, mujoco.mjtSolver.mjSOL_NEWTON
    other.opt.iterations, other.opt.ls_iterations = max(100, m.opt.iterations), max(50, m.opt.ls_iterations)
    other.geom_condim[:], other.pair_dim[:] = np.minimum(m.geom_condim, 3), np.minimum(m.pair_dim, 3)
    other.dof_frictionloss[: 6 * scene.floating] = 0
    condim = max((pair_law(m, *pair).condim for pair in (*ground_pairs(m), *scene.geom_pairs)), default=0)
    for there, what in (
        (m.opt.noslip_iterations > 0, "noslip_iterations"),
        (m.opt.solver != other.opt.solver or m.opt.iterations < 100, "a solver that may stop before it converges"),
        (condim > 3, "torsional and rolling friction (condim 4 and 6; it is 3 here)"),
        ((m.dof_frictionloss != other.dof_frictionloss).any(), "frictionloss of a free joint (use <freejoint/>)"),
    ):
        found += [what] * bool(there)
    usual, most = _step_errors(scene, other) if found else (0.0, 0.0)
    if most > LEAST_ERROR:
        yield (
            f"Left out: {', '.join(found)}. Without it a step's change of velocity in MuJoCo differs "
            f"by {usual:.3g} % (median), {most:.3g} % at most."
        )
    if other.opt.integrator == Integrator.mjINT_IMPLICITFAST and "drag" in scene.features:
        yield "A fluid's drag is that of the velocity before a step; implicitfast takes the one after it."


def _step_errors(scene: Scene, other: mujoco.MjModel) -> tuple[float, float]:
    """Return median and largest difference [%] of a step's change of velocity between the file and another model."""
    there, errors = mujoco.MjData(other), []
    for data in _motion(scene):
        for name in ("qpos", "qvel", "act", "ctrl", "qacc_warmstart"):
            setattr(there, name, getattr(data, name))
        before = data.qvel.copy()
        mujoco.mj_step(scene.mj_model, data)
        mujoco.mj_step(other, there)
        errors.append((abs(there.qvel - data.qvel).max(), abs(data.qvel - before).max()))
    return _relative(*np.array(errors).T)


def _relative(error: Array, change: Array) -> tuple[float, float]:
    """Return median and largest error [%] of changes that are as large as usual: at rest they are next to nothing."""
    relative = 100 * error / (1e-9 + np.maximum(change, np.median(change)))
    return float(np.median(relative)), float(relative.max())


def steps_beside_mujoco(scene: Scene) -> str:
    """Compare steps of the simulator, in float64, with steps of the file in MuJoCo, in one sentence."""
    states, ends, (low, high) = list[tuple[Array, ...]](), list[Array](), control_range(scene.mj_model)
    for data in _motion(scene):
        states.append((data.qpos.copy(), data.qvel.copy(), 2 * (data.ctrl - low) / np.maximum(high - low, 1e-9) - 1))
        mujoco.mj_step(scene.mj_model, data)
        ends.append(data.qvel.copy())
    integration, usual = Integration("mujoco", 1, tolerance=1e-9), wp.config.optimization_level
    sim = Simulator(scene, len(ends), integration, scene.mj_model.opt.timestep, dtype=torch.float64)
    try:
        wp.config.optimization_level = 0  # compiles in a third of the time
        with torch.no_grad():
            ours = sim.step(*(torch.tensor(np.array(x)) for x in zip(*states, strict=True)))[1].numpy()
    finally:
        wp.config.optimization_level = usual
    before, theirs = np.array([qvel for _, qvel, _ in states]), np.array(ends)
    middle, most = _relative(abs(ours - theirs).max(1), abs(theirs - before).max(1))
    return (
        f"In {len(ends)} states a step's change of velocity differs from MuJoCo's by {middle:.2g} % (median), "
        f"{most:.2g} % at most."
    )


def _motion(scene: Scene) -> Iterator[mujoco.MjData]:
    """Yield states of MuJoCo that begin near the file's first keyframe, or its reference pose, on the ground."""
    m, rng = scene.mj_model, np.random.default_rng(0)
    data, (low, high) = mujoco.MjData(m), control_range(m)
    for _ in range(STARTS):
        mujoco.mj_resetData(m, data)
        data.qpos = m.key_qpos[0] if m.nkey else m.qpos0
        mujoco.mj_integratePos(m, data.qpos, 0.05 * rng.normal(size=m.nv), 1.0)
        if scene.ncontact:
            data.qpos += scene.root.up * (trace(scene, data.qpos[None])[0].max() - 0.002)
        data.qvel, data.ctrl = 0.3 * rng.normal(size=m.nv), rng.uniform(low, high)
        for _ in range(8):
            mujoco.mj_step(m, data, 5)
            yield data


def _actuators(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    free = [label(m, Kind.mjOBJ_ACTUATOR, a) for a in np.flatnonzero(m.actuator_ctrllimited == 0).tolist()]
    if free:
        yield f"A control of -1 to 1 is taken as it is by actuators without ctrlrange: {listed(free)}."
    if m.nkey and m.nu:
        zero, start = np.mean(control_range(m), axis=0), start_control(m)
        if len(moved := np.flatnonzero(abs(start - zero) > 1e-6)):
            a, more = int(moved[0]), f", and of {len(moved) - 1} more" * (len(moved) > 1)
            yield (
                "Without a task's action_scale, action 0 is the middle of a ctrlrange, not the ctrl of the file's "
                f"keyframe: {zero[a]:g}, not {start[a]:g}, of actuator {label(m, Kind.mjOBJ_ACTUATOR, a)}{more}."
            )
    if (~motors(m) & muscles(m)).any():
        yield "A control sets the activation of a <muscle> at once."
        yield "A <muscle> pulls with its activation times its maximum force, without MuJoCo's curves."

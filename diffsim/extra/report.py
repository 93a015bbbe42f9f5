"""Report how the simulator reads an MJCF file: `python -m diffsim check robot.xml`"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.contact import HULL_POINTS, base_geoms, collide, declared_pairs, ground_pairs, pair_law
from diffsim.robot.elements import disabled_flags, label, listed, motors
from diffsim.robot.scene import Scene

Kind = mujoco.mjtObj

# How a geom's points stand for it, by its type
ROUGH_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "8 of each rim of a cylinder",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "14 of an ellipsoid's surface",
    int(mujoco.mjtGeom.mjGEOM_MESH): f"at most {HULL_POINTS} corners of a mesh's convex hull",
}


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
    muscles = len(np.unique(scene.segment_muscle))
    ground = f"ground at z = {scene.ground_height:g} m" if scene.ncontact else "no ground that it may touch"
    yield f"links      {scene.nlink - 1} of one degree of freedom, base {'floating' if scene.floating else 'fixed'}"
    yield f"joints     {', '.join(counts)}; {np.count_nonzero(np.isfinite(scene.upper))} limited"
    yield f"state      nq {scene.nq}, nv {scene.nv}"
    yield f"mass       {scene.mass.sum():.4g} kg"
    yield f"controls   {scene.nu - muscles} motors, {muscles} muscles"
    yield f"contact    {scene.ncontact} points, {ground}"
    yield f"features   {', '.join(sorted(scene.features))}"


def approximations(scene: Scene) -> tuple[str, ...]:
    """Return a sentence for each approximation."""
    return tuple(sentence for check in (_self_contact, _ground, _actuators) for sentence in check(scene))


def self_pairs(m: mujoco.MjModel) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield the robot's geoms, each with the later ones of other bodies that it may touch."""
    weld = m.body_weldid[m.geom_bodyid]
    parent = m.body_weldid[m.body_parentid[weld]]
    filters = "filterparent" not in disabled_flags(m)
    parts = np.flatnonzero((weld > 0) | base_geoms(m))
    declared = [pair for pair in declared_pairs(m) if np.isin(pair, parts).all()]
    for k, a in enumerate(parts.tolist()):
        b = parts[k + 1 :]
        related = ((parent[a] == weld[b]) | (parent[b] == weld[a])) & (weld[a] > 0) & (weld[b] > 0)
        touch = (weld[a] != weld[b]) & ~(filters & related) & collide(m, a, b)
        if len(b := b[touch | np.isin(b, [second for first, second in declared if first == a])]):
            yield a, b


def _self_contact(scene: Scene) -> Iterator[str]:
    m, pairs = scene.mj_model, list(self_pairs(scene.mj_model))
    if not pairs:
        return
    names = " and ".join(label(m, Kind.mjOBJ_GEOM, int(geom)) for geom in (pairs[0][0], pairs[0][1][0]))
    number = sum(len(others) for _, others in pairs)
    count = f"{number} pairs of geoms, such as" if number > 1 else "the geoms"
    base = base_geoms(m)
    own = any(base[[a, *others]].any() for a, others in pairs)
    yield (
        f"The robot's parts pass through each other: {count} {names}, would collide in MuJoCo."
        + " Geoms of its fixed base are among them." * own
    )


def _ground(scene: Scene) -> Iterator[str]:
    m, pairs = scene.mj_model, ground_pairs(scene.mj_model)
    kinds = {int(m.geom_type[geom]) for _, geom in pairs}
    if told := ", ".join(what for kind, what in ROUGH_SHAPES.items() if kind in kinds):
        yield f"The ground feels these points of a shape: {told}."
    if any(pair_law(m, *pair).condim > 3 for pair in pairs):
        yield "Torsional and rolling friction, condim 4 and 6, are left out: contact has condim 3."


def _actuators(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    free = [label(m, Kind.mjOBJ_ACTUATOR, a) for a in np.flatnonzero(m.actuator_ctrllimited == 0).tolist()]
    if free:
        yield f"A control of -1 to 1 is taken as it is by actuators without ctrlrange: {listed(free)}."
    if (~motors(m) & (m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)).any():
        yield "A control sets the activation of a <muscle> at once."
        yield "A <muscle> pulls with its activation times its maximum force, without MuJoCo's curves."

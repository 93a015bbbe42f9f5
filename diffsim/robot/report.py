"""What the simulator makes of an MJCF file: used, approximated, told. `python -m diffsim check robot.xml`"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from diffsim.robot.constants import (
    CARRIERS,
    HULL_POINTS,
    STEP,
    PairLaw,
    asked,
    base_geoms,
    ground_pairs,
    label,
    listed,
    mass_matrix,
    motors,
    numeric,
    pair_law,
    recovery,
    self_pairs,
)
from diffsim.robot.constraint import contact_margin
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene

Kind = mujoco.mjtObj
FASTEST = 1e5  # m/s or rad/s, beyond which the simulator contains an environment
MANY_POINTS = 1000

# How a geom's points stand for it, by its type
ROUGH_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "8 of each rim of a cylinder",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "14 of an ellipsoid's surface",
    int(mujoco.mjtGeom.mjGEOM_MESH): f"at most {HULL_POINTS} corners of a mesh's convex hull",
}

# Where a constant comes from that the file does not name.
SOURCES = {
    "k_n": "mass, shared by {carriers} contact points, and solref",
    "k_d": "k_n and solref",
    "k_t": "least apparent mass of a contact point",
    "mu": "friction of the lowest geom and the ground",
    "k_limit": "inertia that each joint moves, and solreflimit",
    "d_limit": "inertia that each joint moves, and solreflimit",
}


def report(scene: Scene) -> str:
    """A page of text about a scene."""
    sections = [
        (f"{scene.name}: can be simulated", list(_parts(scene))),
        ("constants of contact and limits", list(_constants(scene))),
        ("approximated", [f"- {sentence}" for sentence in scene.approximations]),
    ]
    return "\n\n".join("\n  ".join([title, *lines]) for title, lines in sections if lines)


def _parts(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    moving = sorted(
        f"{np.count_nonzero(m.jnt_type == kind)} {name.removeprefix('mjJNT_').lower()}"
        for name, kind in mujoco.mjtJoint.__members__.items()
        if (m.jnt_type == kind).any()
    )
    limited = np.count_nonzero(np.isfinite(scene.upper))
    muscles = len(np.unique(scene.segment_muscle))
    shares = {"motors": scene.nu - muscles, "muscles": muscles}
    yield f"links      {scene.nlink - 1} of one degree of freedom, base {'floating' if scene.floating else 'fixed'}"
    yield f"joints     {', '.join(moving)}; {limited} limited"
    yield f"state      nq {scene.nq}, nv {scene.nv}"
    yield f"mass       {scene.mass.sum():.4g} kg"
    yield f"controls   {', '.join(f'{n} {what}' for what, n in shares.items() if n) or 'none'}"
    ground = f"ground at z = {scene.ground_height:g} m" if scene.ncontact else "no ground that it may touch"
    yield f"contact    {scene.ncontact} points, {ground}"
    yield f"features   {', '.join(sorted(scene.features))}"


def _constants(scene: Scene) -> Iterator[str]:
    limited = np.isfinite(scene.upper)
    for name, unit in PENALTY_CONSTANTS.items():
        values = np.atleast_1d(getattr(scene, name))
        if name.endswith("_limit"):
            values = values[limited]
        if not (len(values) and (scene.ncontact or name.endswith("_limit"))):
            continue
        span = f"{values[0]:.4g}" if np.ptp(values) == 0 else f"{values.min():.4g} to {values.max():.4g}"
        source = SOURCES[name].format(carriers=min(CARRIERS, scene.ncontact))
        source = "the file" if len(numeric(scene.mj_model, name)) else f"default: {source}"
        yield f"{name:8} {span:>18} {unit:25} {source}"


# What is simulated only roughly, in sentences -------------------------------------------------------------------------


def approximations(scene: Scene) -> tuple[str, ...]:
    """A sentence for each."""
    checks = troubles, _self_contact, _ground, _limits, _actuators, _stability
    return tuple(sentence for check in checks for sentence in check(scene))


def troubles(scene: Scene) -> list[str]:
    """What a user should hear at once: a robot that leaves the finite numbers in its first step, or a slow one."""
    m, sentences = scene.mj_model, []
    force = abs(scene.gear) + abs(scene.motor_bias)
    gear = np.linalg.norm(m.actuator_gear, axis=1)
    speed = STEP * m.actuator_acc0 * np.divide(force, gear, out=np.zeros_like(force), where=gear > 0)
    for a in np.flatnonzero(speed > FASTEST).tolist():
        name = label(m, Kind.mjOBJ_ACTUATOR, a)
        sentences.append(
            f"Actuator {name} at full control: {speed[a]:.2g} m/s or rad/s after a substep, {FASTEST:g} at most."
        )
    if scene.ncontact > MANY_POINTS:
        sentences.append(f"{scene.ncontact} contact points are slow: each takes part in every substep.")
    return sentences


def _self_contact(scene: Scene) -> list[str]:
    m, pairs = scene.mj_model, list(self_pairs(scene.mj_model))
    if not pairs:
        return []
    names = " and ".join(label(m, Kind.mjOBJ_GEOM, int(geom)) for geom in (pairs[0][0], pairs[0][1][0]))
    number = sum(len(others) for _, others in pairs)
    count = f"{number} pairs of geoms, such as" if number > 1 else "the geoms"
    told = f"The robot's parts pass through each other: {count} {names}, would collide in MuJoCo."
    base = any(base_geoms(m)[[a, *others]].any() for a, others in pairs)
    return [told + " Geoms of its fixed base are among them." * base]


def _ground(scene: Scene) -> list[str]:
    if not scene.ncontact:
        return []
    m, pairs = scene.mj_model, ground_pairs(scene.mj_model)
    sentences = ["Contact is a spring and a damper under each contact point."]
    if weight := scene.mass.sum() * np.linalg.norm(scene.gravity) * (scene.k_n > 0):
        depth = 1e3 * weight / (scene.k_n * min(CARRIERS, scene.ncontact))
        sentences[0] = f"Contact is a spring and a damper: at rest the robot sinks in by about {depth:.2g} mm."
    if scene.mu > 0:
        sentences.append("Friction is a ramp up to Coulomb's bound: what is pushed sideways creeps.")
    sentences += _one_law_for_all(scene, [pair_law(m, *pair) for pair in pairs])
    if margin := max(contact_margin(m, *pair) for pair in pairs):
        sentences.append(f"Geoms touch where they are, not at their margin of up to {margin:g} m.")
    kinds = {int(m.geom_type[geom]) for _, geom in pairs}
    if told := ", ".join(what for kind, what in ROUGH_SHAPES.items() if kind in kinds):
        sentences.append(f"The ground feels these points of a shape: {told}.")
    if max(pair_law(m, *pair).condim for pair in pairs) > 3:
        sentences.append("Torsional and rolling friction, condim 4 and 6, are left out: contact has condim 3.")
    if inside := len(scene.spheres.geom) - scene.ncontact:
        sentences.append(f"Contact points that lie inside others in every pose are left out: {inside}.")
    return sentences


def _one_law_for_all(scene: Scene, laws: list[PairLaw]) -> list[str]:
    """Where the file distinguishes between geoms, or asks for more than a substep can follow."""
    m, sentences = scene.mj_model, []
    frictions, solrefs = {law.friction * (law.condim > 1) for law in laws}, {law.solref for law in laws}
    if not len(numeric(m, "mu")) and len(frictions) > 1:
        span = f"{min(frictions):g} to {max(frictions):g}"
        sentences.append(f"One coefficient of friction, {scene.mu:g}, serves all geoms; the file has {span}.")
    if len(numeric(m, "k_n")):
        return sentences
    if len(solrefs) > 1:
        sentences.append("One solref serves all geoms: that of the lowest one in the reference pose.")
    share = scene.mass.sum() / min(CARRIERS, scene.ncontact)
    if all(scene.k_n < 0.99 * share * asked(solref).stiffness for solref in solrefs):
        sentences.append("The ground is softer than solref asks, for the lightest part and substeps of 1/960 s.")
    return sentences


def _limits(scene: Scene) -> list[str]:
    if "limit" not in scene.features:
        return []
    m, sentences = scene.mj_model, ["A joint limit is a spring and a damper; solimplimit is ignored."]
    limited = np.flatnonzero(m.jnt_limited).tolist()
    fast = [joint for joint in limited if recovery(m.jnt_solref[joint]) != asked(m.jnt_solref[joint])]
    if fast and not len(numeric(m, "k_limit")):
        joints = listed(label(m, Kind.mjOBJ_JOINT, joint) for joint in fast)
        sentences.append(f"A solreflimit faster than substeps of 1/960 s can follow is slowed down: {joints}.")
    if margin := m.jnt_margin[limited].max():
        sentences.append(f"Limits act where the range ends, not at their margin of up to {margin:g}.")
    return sentences


def _actuators(scene: Scene) -> list[str]:
    m, sentences = scene.mj_model, []
    free = [label(m, Kind.mjOBJ_ACTUATOR, a) for a in np.flatnonzero(m.actuator_ctrllimited == 0).tolist()]
    if free:
        sentences.append(f"A control of -1 to 1 is taken as it is by actuators without ctrlrange: {listed(free)}.")
    if (~motors(m) & (m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)).any():
        sentences.append("A control sets the activation of a <muscle> at once.")
        sentences.append("A <muscle> pulls with its activation times its maximum force, without MuJoCo's curves.")
    return sentences


def _stability(scene: Scene) -> list[str]:
    """Springs and dampers of the joints, in the reference pose; MuJoCo takes dampers implicitly."""
    sentences = []
    if not scene.features & {"damping", "drag"} and scene.features & {"hinge", "ball"}:
        sentences.append("Nothing damps the joints: semi_implicit drifts in energy; the extrapolated one hardly does.")
    first = 6 if scene.floating else 0
    inverse = np.linalg.inv(mass_matrix(scene.mj_model))[first:, first:]
    laws = ((scene.stiffness + scene.servo_stiffness)[1:], (scene.damping + scene.servo_damping)[1:])
    k, b = (abs(np.linalg.eigvals(inverse * law)).max(initial=0) for law in laws)
    if k * STEP**2 + 2 * b * STEP < 4:  # semi-implicit Euler of v' = -b v - k x
        return sentences
    joint = scene.mj_model.dof_jntid[first + int((np.diag(inverse) * (laws[0] * STEP + laws[1])).argmax())]
    name = label(scene.mj_model, Kind.mjOBJ_JOINT, int(joint))
    steps = int(np.ceil((b + np.sqrt(b**2 + 4 * k)) / 4 / 60))
    return [*sentences, f"Spring or damper of joint {name}: semi_implicit needs {steps} substeps of 1/60 s or more."]

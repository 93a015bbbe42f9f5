"""What an MJCF file asks for and the simulator does only roughly, in sentences."""

from __future__ import annotations

import mujoco
import numpy as np

from diffsim.robot.constants import CARRIERS, STEP, asked, mass_matrix, recovery
from diffsim.robot.ground import PairLaw, ground_pairs, pair_law, self_pairs
from diffsim.robot.refuse import is_motor, label
from diffsim.robot.scene import Scene

GEOM = mujoco.mjtObj.mjOBJ_GEOM


def approximations(scene: Scene) -> tuple[str, ...]:
    """A sentence for each."""
    return (*_self_contact(scene.mj_model), *_ground(scene), *_limits(scene), *_actuators(scene), *_stability(scene))


def _self_contact(m: mujoco.MjModel) -> list[str]:
    pairs = self_pairs(m)
    if not pairs:
        return []
    names = " and ".join(label(m, GEOM, geom) for geom in pairs[0])
    count = f"{len(pairs)} pairs of geoms, such as" if len(pairs) > 1 else "the geoms"
    return [f"The robot's parts pass through each other: {count} {names}, would collide in MuJoCo."]


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
    if margin := max(m.geom_margin[list(pair)].max() for pair in pairs):
        sentences.append(f"Geoms touch where they are, not at their margin of up to {margin:g} m.")
    points = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2, mujoco.mjtGeom.mjGEOM_BOX: 8}
    if inside := sum(points[mujoco.mjtGeom(m.geom_type[geom])] for _, geom in pairs) - scene.ncontact:
        sentences.append(f"Contact points that lie inside others in every pose are left out: {inside}.")
    return sentences


def _one_law_for_all(scene: Scene, laws: list[PairLaw]) -> list[str]:
    """Where the file distinguishes between geoms, or asks for more than a substep can follow."""
    m, sentences = scene.mj_model, []
    frictions, solrefs = {law.friction for law in laws}, {law.solref for law in laws}
    if not named(m, "mu") and len(frictions) > 1:
        span = f"{min(frictions):g} to {max(frictions):g}"
        sentences.append(f"One coefficient of friction, {scene.mu:g}, serves all geoms; the file has {span}.")
    if named(m, "k_n"):
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
    if fast and not named(m, "k_limit"):
        joints = ", ".join(label(m, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in fast)
        sentences.append(f"A solreflimit faster than substeps of 1/960 s can follow is slowed down: {joints}.")
    if margin := m.jnt_margin[limited].max():
        sentences.append(f"Limits act where the range ends, not at their margin of up to {margin:g}.")
    return sentences


def _actuators(scene: Scene) -> list[str]:
    m, sentences = scene.mj_model, []
    free = [label(m, mujoco.mjtObj.mjOBJ_ACTUATOR, a) for a in np.flatnonzero(m.actuator_ctrllimited == 0).tolist()]
    if free:
        sentences.append(f"A control of -1 to 1 is taken as it is by actuators without ctrlrange: {', '.join(free)}.")
    if not all(is_motor(m, a) for a in range(m.nu)):
        sentences.append("A control sets the activation of a <muscle> at once.")
        if scene.muscle_model != "hill":
            sentences.append("A <muscle> pulls with its activation times its maximum force, without MuJoCo's curves.")
    return sentences


def _stability(scene: Scene) -> list[str]:
    """Springs and dampers of the joints, in the reference pose; MuJoCo takes dampers implicitly."""
    first = 6 if scene.floating else 0
    inverse = np.linalg.inv(mass_matrix(scene.mj_model))[first:, first:]
    laws = (scene.stiffness[1:], scene.damping[1:])
    k, b = (abs(np.linalg.eigvals(inverse * law)).max(initial=0) for law in laws)
    if k * STEP**2 + 2 * b * STEP < 4:  # semi-implicit Euler of v' = -b v - k x
        return []
    joint = scene.mj_model.dof_jntid[first + int((np.diag(inverse) * (laws[0] * STEP + laws[1])).argmax())]
    name = label(scene.mj_model, mujoco.mjtObj.mjOBJ_JOINT, int(joint))
    steps = int(np.ceil((b + np.sqrt(b**2 + 4 * k)) / 4 / 60))
    return [f"Spring or damper of joint {name}: semi_implicit needs {steps} substeps of 1/60 s or more."]


def named(m: mujoco.MjModel, name: str) -> bool:
    """Whether the file sets this constant."""
    return mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0

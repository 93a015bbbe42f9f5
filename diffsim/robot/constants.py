"""MuJoCo's constraints of a robot, from its file's solref, solimp, friction, margin and frictionloss.

Nothing here is fitted. MuJoCo's documentation, "Computation", defines the law;
kernels/mujoco/impedance.py has the equations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from diffsim.robot.contacts import ground_pairs, pair_law
from diffsim.robot.elements import disabled_flags, enabled_flags, label, listed, takes_euler
from diffsim.robot.pairs import room_of, rows_of
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene
from diffsim.robot.types import Array, Constraints, SceneError

# MuJoCo's bounds of an impedance, and of the friction of a contact with friction
LEAST, MOST, LEAST_FRICTION = 1e-4, 0.9999, 1e-5
# MuJoCo's bound of an inverse weight, 0 of a link that turns about its centre of mass; and one for single precision
LEAST_WEIGHT, LEAST_WEIGHT_SINGLE = 1e-15, 1e-7
MOST_NUMBER = 1e15  # of a constraint's constants, whose squares single precision still holds
IMPEDANCE = slice(5, 8)  # of a row of constants: the impedance's ends and width
SOFT = 0.015  # impedance with which a contact of a chosen onset begins, that of Menagerie's Go1 and Go2
LEAST_SOFTNESS = 1e-6  # of a pyramid's edges, at which Newton's method fails in single precision


def constrained(scene: Scene, seconds: float, single: bool = True, onset: float = 0.0) -> Scene:
    """Return a copy with MuJoCo's constraints for that length of a substep, to be solved in single precision or not.

    Contacts begin over a length of `onset` [m], see soften.

    Raises:
        SceneError: a constraint is not supported, or too stiff for single precision.
    """
    m = scene.mj_model
    if found := list(_obstacles(scene)):
        raise SceneError(f"{scene.name}: on MuJoCo's contact {'; '.join(found)}")
    fastest = 0.0 if "refsafe" in disabled_flags(m) else 2 * seconds
    ground = ground_pairs(m)[0][0] if len(scene.spheres.geom) else 0

    def touch(a: int, b: int) -> Array:
        return _contact(scene, a, b, fastest, single, onset)

    contact = [touch(ground, geom) for geom in scene.spheres.geom.tolist()]
    least = LEAST_WEIGHT_SINGLE if single else LEAST_WEIGHT

    def row(solref: Array, solimp: Array, weight: float, what: str) -> Array:
        return _in_range(_numbers(solref, solimp, max(weight, least), 0.0, fastest), f"{scene.name}: {what}")

    first = m.nv - scene.nlink + 1
    limit, loss = np.tile(_numbers((1.0, 1.0), (0.9, 0.9, 1.0, 0.5, 2.0), 1.0, 0.0), (scene.nlink, 1)), []
    for link, dof in enumerate(range(first, m.nv), start=1):
        joint, weight = m.dof_jntid[dof], m.dof_invweight0[dof]
        limit[link, 4] = weight
        if np.isfinite(scene.lower[link]):
            numbers = _numbers(m.jnt_solref[joint], m.jnt_solimp[joint], weight, m.jnt_margin[joint], fastest)
            limit[link] = _in_range(numbers, f"{scene.name}: joint {label(m, mujoco.mjtObj.mjOBJ_JOINT, joint)}")
        k, b, _, _, _, d, *_ = _numbers(m.dof_solref[dof], m.dof_solimp[dof], weight, 0.0, fastest)
        loss.append((m.dof_frictionloss[dof], d / ((1 - d) * weight), b))
    damping, servo_damping = scene.damping, scene.servo_damping
    if takes_euler(m):  # which takes a servo's damping explicitly, and so apart from the joint's own
        damping = np.minimum(damping, np.append(0.0, m.dof_damping[first:]))
        servo_damping = servo_damping + scene.damping - damping
    return dataclasses.replace(
        scene,
        damping=damping,
        servo_damping=servo_damping,
        contact_link=scene.spheres.link,
        contact_position=scene.spheres.centre,
        contact_radius=scene.spheres.radius,
        constraints=Constraints(
            np.array(contact).reshape(-1, 11),
            scene.spheres.axis,
            limit,
            np.array([(0.0, 1.0, 0.0), *loss]),
            rows_of(scene, row, touch),
            room_of(scene),
        ),
    )


def check_soft(scene: Scene) -> None:
    """Raise SceneError if soft contact does not support the file, or the file lacks a constant of soft contact."""
    m = scene.mj_model
    joints = np.unique(m.dof_jntid[m.dof_frictionloss > 0]).tolist()
    if joints:
        names = listed(label(m, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in joints)
        raise SceneError(f"{scene.name}: soft contact has no frictionloss (joint {names}); choose MuJoCo's contact")
    if scene.geom_pairs:
        raise SceneError(f"{scene.name}: soft contact has no contact between bodies; choose MuJoCo's contact")
    if rows := np.flatnonzero(m.eq_active0).tolist():
        names = listed(label(m, mujoco.mjtObj.mjOBJ_EQUALITY, k) for k in rows)
        raise SceneError(f"{scene.name}: soft contact has no equality constraints ({names}); choose MuJoCo's contact")
    unnamed = [name for name in PENALTY_CONSTANTS if np.isnan(getattr(scene, name)).any()]
    if missing := [name for name in unnamed if scene.ncontact or name.endswith("_limit")]:
        raise SceneError(
            f"{scene.name}: soft contact needs {', '.join(missing)}; choose MuJoCo's contact, give them as penalty, "
            f'or name them in the file: <custom><numeric name="{missing[0]}" data="1e4"/></custom>'
        )


def soften(solimp: Array, onset: float) -> Array:
    """Return solimp (5,) of a contact that begins softly, or as it is if its impedance rises no faster.

    The impedance begins with at most SOFT and rises over at least `onset` [m], so the contact is nowhere stiffer. A
    force that begins at zero has a derivative with respect to the time at which the contact begins. With an onset of 0
    nothing changes.
    """
    start, end, width, middle, power = solimp
    return np.array([min(start, SOFT), end, max(width, onset), middle, power]) if onset else solimp


def _contact(scene: Scene, ground: int, geom: int, fastest: float, single: bool, onset: float) -> Array:
    m = scene.mj_model
    law = pair_law(m, ground, geom)
    weight = m.body_invweight0[m.geom_bodyid[[ground, geom]], 0].sum()
    weight = max(weight, LEAST_WEIGHT_SINGLE if single else LEAST_WEIGHT)
    friction = max(law.friction, LEAST_FRICTION) if law.condim > 1 else 0.0
    numbers = _numbers(law.solref, soften(law.solimp, onset), weight, law.margin, fastest)
    numbers[2:4] = friction, 1 / m.opt.impratio
    name, end = f"{scene.name}: geom {label(m, mujoco.mjtObj.mjOBJ_GEOM, geom)}", numbers[5:7].max()
    edges = 2 * friction**2 * (1 + friction**2) / m.opt.impratio * (1 - end) / end
    if single and m.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and 0 < edges < LEAST_SOFTNESS:
        raise SceneError(
            f"{name}: so little friction or large impratio makes a pyramidal cone too stiff for float32; take condim 1 "
            "or the elliptic cone"
        )
    return _in_range(numbers, name)


def _in_range(numbers: Array, what: str) -> Array:
    """Return a row of constants; raises SceneError if single precision does not hold their squares."""
    if not np.abs(numbers).max() < MOST_NUMBER:
        raise SceneError(f"{what}: its solref, solimp, friction or impratio is out of range")
    return numbers


def _obstacles(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    if "diagexact" in enabled_flags(m):
        yield "the option flag diagexact cannot be enabled"
    width = m.jnt_range[:, 1] - m.jnt_range[:, 0]
    for joint in np.flatnonzero((m.jnt_limited != 0) & (2 * m.jnt_margin >= width)).tolist():
        yield f"the margins of the limits of joint {label(m, mujoco.mjtObj.mjOBJ_JOINT, joint)} meet"


def _numbers(solref: ArrayLike, solimp: ArrayLike, weight: float, margin: float, fastest: float = 0.0) -> Array:
    """Compute a row of Constraints.contact without friction; no time constant is below `fastest`."""
    (first, second), (start, end, width, middle, power) = np.asarray(solref), np.asarray(solimp)
    start, end, middle = np.clip((start, end, middle), LEAST, MOST)
    if first > 0:
        first = max(first, fastest)
        k, b = 1 / (end * first * second) ** 2, 2 / (end * first)
    else:
        k, b = -first / end**2, -second / end
    if width <= 1e-15:
        start, end, width = (start + end) / 2, (start + end) / 2, 1.0
    return np.array([k, b, 0.0, 1.0, weight, start, end, width, middle, max(power, 1.0), margin])

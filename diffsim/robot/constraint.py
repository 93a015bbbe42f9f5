"""MuJoCo's own constraints of a robot: what its file asks for by solref, solimp, friction, margin and frictionloss.

Nothing here is fitted; MuJoCo's documentation, "Computation", has the law, kernels/constraint.py the equations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from diffsim.robot.constants import declared_pairs, disabled_flags, enabled_flags, ground_pairs, label, listed, pair_law
from diffsim.robot.scene import Array, Scene, SceneError

# MuJoCo's own bounds: of an impedance, and of the friction of a contact that has any
LEAST, MOST, LEAST_FRICTION = 1e-4, 0.9999, 1e-5


class Constraints(NamedTuple):
    """Numbers of MuJoCo's constraints, for one length of a substep."""

    # (nc, 11) k [1/s^2] and b [1/s]; friction; 1 / impratio; inverse weight [1/kg]; the impedance's ends, width [m],
    # midpoint and power; margin [m]
    contact: Array
    limit: Array  # (nlink, 11) the same of each joint, in its units; friction and impratio are of no use
    loss: Array  # (nlink, 3) of each joint's dry friction: its bound [N or N m], D [kg or kg m^2] and b [1/s]


def constrained(scene: Scene, seconds: float) -> Scene:
    """A copy with MuJoCo's constraints in substeps of that length; raises SceneError for what of the file they lack."""
    m = scene.mj_model
    if found := list(_obstacles(scene)):
        raise SceneError(f"{scene.name}: with the integrator mujoco {'; '.join(found)}")
    fastest = 0.0 if "refsafe" in disabled_flags(m) else 2 * seconds
    ground = ground_pairs(m)[0][0] if len(scene.spheres.geom) else 0
    contact = [_contact(m, ground, geom, fastest) for geom in scene.spheres.geom.tolist()]
    first = m.nv - scene.nlink + 1
    limit, loss = np.tile(_numbers((1.0, 1.0), (0.9, 0.9, 1.0, 0.5, 2.0), 1.0, 0.0), (scene.nlink, 1)), []
    for link, dof in enumerate(range(first, m.nv), start=1):
        joint, weight = m.dof_jntid[dof], m.dof_invweight0[dof]
        if np.isfinite(scene.lower[link]):
            limit[link] = _numbers(m.jnt_solref[joint], m.jnt_solimp[joint], weight, m.jnt_margin[joint], fastest)
        k, b, _, _, _, d, *_ = _numbers(m.dof_solref[dof], m.dof_solimp[dof], weight, 0.0, fastest)
        loss.append((m.dof_frictionloss[dof], d / ((1 - d) * weight), b))
    return dataclasses.replace(
        scene,
        contact_link=scene.spheres.link,
        contact_position=scene.spheres.centre,
        contact_radius=scene.spheres.radius,
        constraints=Constraints(np.array(contact).reshape(-1, 11), limit, np.array([(0.0, 1.0, 0.0), *loss])),
    )


def check_springs(scene: Scene, integrator: str) -> None:
    """Raises SceneError where another integrator lacks what the file asks for."""
    m = scene.mj_model
    joints = np.unique(m.dof_jntid[m.dof_frictionloss > 0]).tolist()
    if joints:
        names = listed(label(m, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in joints)
        raise SceneError(f"{scene.name}: the integrator {integrator} has no frictionloss (joint {names}); mujoco has")


def _contact(m: mujoco.MjModel, ground: int, geom: int, fastest: float) -> Array:
    law = pair_law(m, ground, geom)
    weight = m.body_invweight0[m.geom_bodyid[[ground, geom]], 0].sum()
    friction = max(law.friction, LEAST_FRICTION) if law.condim > 1 else 0.0
    numbers = _numbers(law.solref, law.solimp, weight, contact_margin(m, ground, geom), fastest)
    numbers[2:4] = friction, 1 / m.opt.impratio
    return numbers


def contact_margin(m: mujoco.MjModel, ground: int, geom: int) -> float:
    """Of a contact of these two: the distance at which it begins [m]."""
    if (pair := declared_pairs(m).get((min(ground, geom), max(ground, geom)))) is not None:
        return float(m.pair_margin[pair] - (0.0 if _margins_add() else m.pair_gap[pair]))
    margin, gap = m.geom_margin[[ground, geom]], m.geom_gap[[ground, geom]]
    return float(margin.sum() if not margin.any() or _margins_add() else margin.max() - gap.max())


@cache
def _margins_add() -> bool:
    """Whether a contact acts within the sum of its geoms' margins; in older versions it is the larger, less the gap."""
    geom = '<geom type="{}" size="1 1 1" margin="1"/>'
    body = f"<body><freejoint/>{geom.format('sphere')}</body>"
    m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom.format('plane')}{body}</worldbody></mujoco>")
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    return bool(data.contact[0].includemargin > 1.5)


def _obstacles(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    if scene.terrain is not None:
        yield "the ground is a plane, no terrain"
    if "diagexact" in enabled_flags(m):
        yield "the option flag diagexact cannot be enabled"
    width = m.jnt_range[:, 1] - m.jnt_range[:, 0]
    for joint in np.flatnonzero((m.jnt_limited != 0) & (2 * m.jnt_margin >= width)).tolist():
        yield f"the margins of the limits of joint {label(m, mujoco.mjtObj.mjOBJ_JOINT, joint)} meet"


def _numbers(solref: ArrayLike, solimp: ArrayLike, weight: float, margin: float, fastest: float = 0.0) -> Array:
    """A row of Constraints.contact without friction; no time constant is below `fastest`."""
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

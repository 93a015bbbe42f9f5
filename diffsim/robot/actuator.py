"""Actuators that are more than motors of joints: servos, bounds of forces, fixed tendons and sites."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.contacts import matrix_of
from diffsim.robot.elements import motors, muscles, servos, takes_euler
from diffsim.robot.types import Array, Transmissions

Transmission, Ball = mujoco.mjtTrn, mujoco.mjtJoint.mjJNT_BALL
Mask = NDArray[np.bool_]
Body = tuple[int, Array, Array]  # a body's link, and its orientation and position in the link's frame


def on_joint(m: mujoco.MjModel) -> Mask:
    """Mark actuators on a joint."""
    return m.actuator_trntype == Transmission.mjTRN_JOINT


def on_tendon(m: mujoco.MjModel) -> Mask:
    """Mark actuators on a fixed tendon."""
    return (m.actuator_trntype == Transmission.mjTRN_TENDON) & ~muscles(m)


def at_site(m: mujoco.MjModel) -> Mask:
    """Mark actuators at a site."""
    return m.actuator_trntype == Transmission.mjTRN_SITE


def joints_of(m: mujoco.MjModel, a: int) -> tuple[NDArray[np.int32], Array]:
    """Return the joints that an actuator on a joint or on a fixed tendon moves, and their coefficients."""
    target = m.actuator_trnid[a, 0]
    if m.actuator_trntype[a] == Transmission.mjTRN_JOINT:
        return np.array([target], np.int32), np.ones(1)
    path = slice(m.tendon_adr[target], m.tendon_adr[target] + m.tendon_num[target])
    return m.wrap_objid[path], m.wrap_prm[path]


def driven(m: mujoco.MjModel) -> list[int]:
    """List the joints of actuators on joints and on fixed tendons, each as often as it has such an actuator."""
    return [joint for a in np.flatnonzero(on_joint(m) | on_tendon(m)).tolist() for joint in joints_of(m, a)[0].tolist()]


def gear_of(m: mujoco.MjModel, a: int, nlink: int) -> tuple[int, float]:
    """Return the link of a joint's actuator, and the joint's force per force of the actuator."""
    joint, axis = m.actuator_trnid[a, 0], 0
    if m.jnt_type[joint] == Ball:  # a torque about one axis of the turned body's frame
        axis = int(np.abs(m.actuator_gear[a, :3]).argmax())
    return _link(m, joint, nlink) + axis, m.actuator_gear[a, axis]


def _link(m: mujoco.MjModel, joint: int, nlink: int) -> int:
    return int(m.jnt_dofadr[joint]) - m.nv + nlink


def turning(m: mujoco.MjModel) -> Mask:
    """Mark motors and servos of a hinge or of a slide, and motors of one axis of a ball joint."""
    turns = (motors(m) | servos(m)) & on_joint(m)
    found = np.flatnonzero(turns)
    kind, axes = m.jnt_type[m.actuator_trnid[found, 0]], np.count_nonzero(m.actuator_gear[found, :3], axis=1)
    turns[found] = np.where(kind == Ball, motors(m)[found] & (axes <= 1), kind != mujoco.mjtJoint.mjJNT_FREE)
    return turns


class Servo(NamedTuple):
    """What servos add to each degree of freedom after the base, in its units."""

    push: Array  # (joints,) force at position zero
    stiffness: Array  # (joints,)
    damping: Array  # (joints,)

    def where(self, mask: Mask) -> Servo:
        """Return a copy that is zero elsewhere."""
        return Servo(*(np.where(mask, values, 0.0) for values in self))


def servo_sums(m: mujoco.MjModel, nlink: int) -> Servo:
    """Sum the affine biases of the joints' actuators."""
    sums = np.zeros((3, nlink - 1))
    for a in np.flatnonzero(servos(m) & on_joint(m)).tolist():
        link, gear = gear_of(m, a, nlink)
        sums[:, link - 1] += m.actuator_biasprm[a, :3] * (gear, -(gear**2), -(gear**2))
    return Servo(*sums)


def force_bounds(m: mujoco.MjModel, nlink: int) -> Array:
    """Read the bounds (2, joints) of the total force of each joint's actuators."""
    bounds = np.tile((-np.inf, np.inf), (nlink - 1, 1))
    for a in np.flatnonzero(on_joint(m) & (m.actuator_forcelimited != 0)).tolist():  # the only one on its joint
        link, gear = gear_of(m, a, nlink)
        bounds[link - 1] = np.sort(gear * m.actuator_forcerange[a])
    for joint in sorted(set(driven(m))):
        if m.jnt_actfrclimited[joint] and m.jnt_type[joint] != Ball:
            own = bounds[_link(m, joint, nlink) - 1]
            own[:] = own.clip(*m.jnt_actfrcrange[joint])
    return bounds.T


def transmissions_of(m: mujoco.MjModel, nlink: int, bodies: list[Body]) -> Transmissions | None:
    """Read the actuators on fixed tendons and at sites."""
    tendons = np.flatnonzero(on_tendon(m)).astype(np.int32)
    law = np.tile((0.0, 0.0, -np.inf, np.inf), (len(tendons), 1))
    law[:, :2] = np.where(servos(m)[tendons, None], -m.actuator_biasprm[tendons, 1:3], 0.0)
    bounded = m.actuator_forcelimited[tendons] != 0
    law[bounded, 2:] = m.actuator_forcerange[tendons[bounded]]
    begin, links, coefs = [0], list[int](), list[float]()
    for a in tendons.tolist():
        joints, coef = joints_of(m, a)
        links += [_link(m, joint, nlink) for joint in joints.tolist()]
        coefs += (m.actuator_gear[a, 0] * coef).tolist()
        begin.append(len(links))
    sites, pushed, torques, forces = list[int](), list[int](), list[Array](), list[Array]()
    for a in np.flatnonzero(at_site(m)).tolist():
        site = m.actuator_trnid[a, 0]
        link, rotation, position = bodies[m.site_bodyid[site]]
        force, torque = m.actuator_gear[a].reshape(2, 3) @ (rotation @ matrix_of(m.site_quat[site])).T
        if link != bodies[0][0]:  # the world does not move
            sites.append(a)
            pushed.append(link)
            torques.append(torque + np.cross(position + rotation @ m.site_pos[site], force))
            forces.append(force)
    if not len(tendons) + len(sites):
        return None
    along = [*np.flatnonzero(_chained(m)[0][tendons]).tolist(), -1][:1]
    begins, link, chain, site, site_link = (np.array(x, np.int32) for x in (begin, links, along, sites, pushed))
    wrenches = (np.array(each).reshape(-1, 3) for each in (torques, forces))
    return Transmissions(tendons, law, begins, link, np.array(coefs), chain, site, site_link, *wrenches)


def refused(m: mujoco.MjModel) -> Iterator[tuple[Mask, str]]:
    """Yield actuators on fixed tendons and at sites that are not simulated, and why."""
    bounded = m.actuator_forcelimited != 0
    fixed = motors(m) & (m.actuator_trnid[:, 1] < 0) & ~bounded
    yield at_site(m) & ~fixed, "only motors at a site, without refsite and forcerange"
    yield on_tendon(m) & ~motors(m) & ~servos(m), "only motors, position and velocity servos on a fixed tendon"
    chained, branched = _chained(m)
    several = branched | chained & (chained.sum() > 1)
    why = "damping of tendons is simulated along one chain of joints, or with the integrator Euler"
    yield several & (not takes_euler(m)), why


def _chained(m: mujoco.MjModel) -> tuple[Mask, Mask]:
    """Mark actuators with damping on a fixed tendon whose joints move each other: all in one chain, or some."""
    chained, branched = np.zeros((2, len(m.actuator_trntype)), bool)
    for a in np.flatnonzero(on_tendon(m) & servos(m) & (m.actuator_biasprm[:, 2] != 0)).tolist():
        dofs = set(m.jnt_dofadr[joints_of(m, a)[0]].tolist())
        moved = 0  # pairs of joints of which one moves the other
        for above in m.dof_parentid[list(dofs)].tolist():
            while above >= 0:
                moved += above in dofs
                above = m.dof_parentid[above]
        chained[a] = 0 < moved == len(dofs) * (len(dofs) - 1) // 2
        branched[a] = moved > 0 and not chained[a]
    return chained, branched

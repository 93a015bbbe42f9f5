"""Constants of contact and limits where a file names none, from the robot's inertia and the file's own solref.

MuJoCo's solref (timeconst, dampratio) asks for a constraint that recovers like a damped spring of 1 / (timeconst
dampratio)^2 and 2 / timeconst per unit of inertia, under a load that the solver has mostly cancelled. A real spring
carries the load itself; FIRMNESS makes up for that as well as one number can (measured over gymnasium's robots).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP = 1 / 960  # s, 16 substeps of 1/60 s: explicit steps up to this one are stable with these constants
CARRIERS = 4  # contact points that share the weight of a robot that has more
FIRMNESS = 2.0  # times what solref asks for
REBOUND = 2.0  # s/m, k_d / k_n at a dampratio of 1: the ground stops pushing what leaves at half a metre a second
LIMIT_REBOUND = 4.0  # s/m or s/rad, d_limit / k_limit likewise


class Recovery(NamedTuple):
    """Of a constraint, per unit of inertia."""

    stiffness: float  # 1/s^2
    damping: float  # 1/s

    @property
    def damping_ratio(self) -> float:
        return self.damping / (2 * np.sqrt(FIRMNESS * self.stiffness)) if self.stiffness > 0 else 0.0


def asked(solref: Sequence[float] | Array) -> Recovery:
    """FIRMNESS times what solref asks for."""
    first, second = map(float, solref)
    if first > 0:
        return Recovery(FIRMNESS / (first * second) ** 2, FIRMNESS * 2 / first)
    return Recovery(-FIRMNESS * first, -FIRMNESS * second)  # MuJoCo's direct format


def recovery(solref: Sequence[float] | Array) -> Recovery:
    """What solref asks for, but no faster than a substep can follow: the idea of MuJoCo's flag refsafe."""
    stiffness, damping = asked(solref)
    return Recovery(min(stiffness, 1 / (2 * STEP) ** 2), min(damping, 1 / STEP))


def contact_constants(mass: float, mobility: Array, solref: Sequence[float]) -> dict[str, float]:
    """k_n, k_d and k_t.

    Args:
        mass: kg, of the robot.
        mobility: (points,) 1/kg, of the contact points, see mobilities.
        solref: of the contact, MJCF's.

    k_n carries its share of the mass as solref asks, but never more than the lightest point stays stable on; k_t halves
    that point's slip in one substep.
    """
    rates = recovery(solref)
    lightest = min(mass, 1 / mobility.max()) if mobility.any() else mass  # kg
    k_n = min(mass * rates.stiffness / min(CARRIERS, len(mobility)), 0.1 * lightest / STEP**2)
    return {"k_n": float(k_n), "k_d": float(REBOUND * rates.damping_ratio * k_n), "k_t": lightest / (2 * STEP)}


def mass_matrix(m: mujoco.MjModel) -> Array:
    """(nv, nv) in the reference pose, as all inertias here; armature included."""
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    matrix = np.eye(m.nv)
    for row, unit in zip(matrix, np.eye(m.nv), strict=True):
        mujoco.mj_mulM(m, data, row, unit)
    return matrix


def mobilities(m: mujoco.MjModel, points: Sequence[tuple[int, Array]]) -> Array:
    """(points,) 1/kg: acceleration per force of points of the robot, in the direction of least inertia.

    Args:
        points: (body, position in the world).
    """
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    jacobians = np.zeros((len(points), 3, m.nv))
    for jacobian, (body, position) in zip(jacobians, points, strict=True):
        mujoco.mj_jac(m, data, jacobian, None, position, body)
    response = jacobians @ np.linalg.inv(mass_matrix(m)) @ jacobians.transpose(0, 2, 1)
    mobility: Array = np.linalg.eigvalsh(response)[:, -1]
    return mobility


def limit_constants(m: mujoco.MjModel) -> tuple[Array, Array]:
    """k_limit, d_limit (nv,): what solreflimit asks for, times the inertia that the joint moves."""
    inertia = 1 / np.diag(np.linalg.inv(mass_matrix(m)))
    rates = [recovery(m.jnt_solref[joint]) for joint in m.dof_jntid]
    k_limit: Array = inertia * np.array([rate.stiffness for rate in rates])
    return k_limit, LIMIT_REBOUND * k_limit * np.array([rate.damping_ratio for rate in rates])

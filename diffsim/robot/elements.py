"""Elements of a compiled MJCF: names, flags, kinds of actuators, and the mass matrix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.types import Array

Kind = mujoco.mjtObj
MOST_NAMES = 8  # in one message


def label(m: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """Return the quoted name of an element, or its number and its body's name."""
    if name := mujoco.mj_id2name(m, kind, index):
        return repr(name)
    bodies = {Kind.mjOBJ_GEOM: m.geom_bodyid, Kind.mjOBJ_JOINT: m.jnt_bodyid, Kind.mjOBJ_SITE: m.site_bodyid}
    body = mujoco.mj_id2name(m, Kind.mjOBJ_BODY, bodies[kind][index]) if kind in bodies else ""
    return f"number {index}" + (f" of body {body!r}" if body else "")


def listed(names: Iterable[str]) -> str:
    """Join the first names, with the number of the others."""
    first = list(names)
    more = [f"and {len(first) - MOST_NAMES} more"] if len(first) > MOST_NAMES + 1 else []
    return ", ".join([*(first[:MOST_NAMES] if more else first), *more])


def numeric(m: mujoco.MjModel, name: str) -> Array:
    """Return the numbers of the <custom><numeric> of that name; none if the file has no such element."""
    index = mujoco.mj_name2id(m, Kind.mjOBJ_NUMERIC, name)
    return m.numeric_data[m.numeric_adr[index] :][: m.numeric_size[index]] if index >= 0 else np.zeros(0)


def floating(m: mujoco.MjModel) -> bool:
    """Tell whether the only tree of bodies has a free joint; beside others it is three slides and a ball."""
    return m.ntree == 1 and bool((m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())


def motors(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark actuators whose force is their control times a constant."""
    still, unbiased = m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE, m.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE
    return still & unbiased & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)


def servos(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark actuators that add a spring and a damper: <position>, <velocity>."""
    still, affine = m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE, m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    return still & affine & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)


def muscles(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark actuators on spatial tendons; a fixed tendon's length is a sum of joint positions."""
    tendon = m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    tendon[tendon] = m.wrap_type[m.tendon_adr[m.actuator_trnid[tendon, 0]]] != mujoco.mjtWrap.mjWRAP_JOINT
    return tendon


def control_range(m: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the controls (nu,) of each actuator to which actions of -1 and 1 are mapped."""
    limited = m.actuator_ctrllimited != 0
    low = np.where(limited, m.actuator_ctrlrange[:, 0], np.where(muscles(m), 0.0, -1.0))
    return low, np.where(limited, m.actuator_ctrlrange[:, 1], 1.0)


def takes_euler(m: mujoco.MjModel) -> bool:
    """Tell whether MuJoCo's constraints are stepped as by its Euler, and not as by its implicitfast."""
    return m.opt.integrator in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)


def home_key(m: mujoco.MjModel) -> int:
    """Return the index of the keyframe "home", else of the first one; -1 if the file has none."""
    return max(mujoco.mj_name2id(m, Kind.mjOBJ_KEY, "home"), min(0, m.nkey - 1))


def disabled_flags(m: mujoco.MjModel) -> set[str]:
    """Return the names of <flag> that the file disables."""
    return _set_bits(mujoco.mjtDisableBit.__members__, "mjDSBL_", m.opt.disableflags)


def enabled_flags(m: mujoco.MjModel) -> set[str]:
    """Return the names of <flag> that the file enables and that are not enabled by default."""
    return _set_bits(mujoco.mjtEnableBit.__members__, "mjENBL_", m.opt.enableflags)


def _set_bits(bits: Mapping[str, int], prefix: str, flags: int) -> set[str]:
    names = [name for name, bit in bits.items() if name.startswith(prefix) and flags & int(bit)]
    return {name.removeprefix(prefix).lower() for name in names}


def at_rest(m: mujoco.MjModel) -> mujoco.MjData:
    """Compute MuJoCo's kinematics of the reference pose, in which no free joint and no ball is turned."""
    data = mujoco.MjData(m)
    for adr in m.jnt_qposadr[m.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist():
        data.qpos[adr + 3 : adr + 7] = 1.0, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    return data


def mass_matrix(m: mujoco.MjModel) -> Array:
    """Compute the mass matrix (nv, nv) of the reference pose with armature.

    MuJoCo's own treats the slides of one body as independent.
    """
    data, matrix = at_rest(m), np.diag(m.dof_armature)
    mujoco.mj_crb(m, data)
    moved, (angular, linear) = data.crb[m.dof_bodyid], np.split(data.cdof, 2, axis=1)
    moment, mass, inertia = moved[:, 6:9], moved[:, 9:], moved[:, [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    turn = (inertia @ angular[:, :, None])[:, :, 0] + np.cross(moment, linear)
    force = np.concatenate((turn, mass * linear - np.cross(moment, angular)), 1)
    ways = list[NDArray[np.int64]]()  # from the world to each
    for dof, parent in enumerate(m.dof_parentid.tolist()):
        ways.append(np.append(ways[parent], dof) if parent >= 0 else np.array([dof]))
        matrix[dof, ways[dof]] += data.cdof[ways[dof]] @ force[dof]
        matrix[ways[dof], dof] = matrix[dof, ways[dof]]
    return matrix

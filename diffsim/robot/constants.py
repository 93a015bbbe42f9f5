"""What a compiled MJCF says beyond its arrays: names, flags, which geoms touch the ground, and constants of contact.

Where a file names no constants, they follow from the robot's inertia and the file's own solref. MuJoCo's solref
(timeconst, dampratio) asks for a constraint that recovers like a damped spring of 1 / (timeconst dampratio)^2 and
2 / timeconst per unit of inertia, under a load that the solver has mostly cancelled. A real spring carries the load
itself; FIRMNESS makes up for that as well as one number can (measured over gymnasium's robots).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Array

Kind = mujoco.mjtObj

MOST_NAMES = 8  # in one message
STEP = 1 / 960  # s, 16 substeps of 1/60 s: explicit steps up to this one are stable with these constants
CARRIERS = 4  # contact points that share the weight of a robot that has more
FIRMNESS = 2.0  # times what solref asks for
REBOUND = 2.0  # s/m, k_d / k_n at a dampratio of 1: the ground stops pushing what leaves at half a metre a second
LIMIT_REBOUND = 4.0  # s/m or s/rad, d_limit / k_limit likewise
HULL_POINTS = 16  # of a mesh, at most
_CORNERS = np.array([[x, y, z] for y in (-1, 1) for x in (-1, 1) for z in (-1, 1)], float)
_RIM = np.array([[np.cos(turn), np.sin(turn), z] for z in (-1, 1) for turn in np.arange(8) * np.pi / 4])
# Where a geom's contact points are, by its type: along its axes, in half lengths; a mesh has its own
POINTS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): np.zeros((1, 3)),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
    int(mujoco.mjtGeom.mjGEOM_BOX): _CORNERS,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _RIM,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): np.concatenate((np.eye(3), -np.eye(3), _CORNERS / np.sqrt(3))),
    int(mujoco.mjtGeom.mjGEOM_MESH): np.zeros((HULL_POINTS, 3)),
}


# Names, flags and kinds -----------------------------------------------------------------------------------------------


def label(m: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """The quoted name of an element, or its number and its body's name."""
    if name := mujoco.mj_id2name(m, kind, index):
        return repr(name)
    bodies = {Kind.mjOBJ_GEOM: m.geom_bodyid, Kind.mjOBJ_JOINT: m.jnt_bodyid, Kind.mjOBJ_SITE: m.site_bodyid}
    body = mujoco.mj_id2name(m, Kind.mjOBJ_BODY, bodies[kind][index]) if kind in bodies else ""
    return f"number {index}" + (f" of body {body!r}" if body else "")


def listed(names: Iterable[str]) -> str:
    """Some names, and how many there are besides."""
    first = list(names)
    more = [f"and {len(first) - MOST_NAMES} more"] if len(first) > MOST_NAMES + 1 else []
    return ", ".join([*(first[:MOST_NAMES] if more else first), *more])


def text(m: mujoco.MjModel, name: str, default: str) -> str:
    """The <custom><text> of that name."""
    index = mujoco.mj_name2id(m, Kind.mjOBJ_TEXT, name)
    return m.text_data[m.text_adr[index] :].partition(b"\0")[0].decode() if index >= 0 else default


def numeric(m: mujoco.MjModel, name: str) -> Array:
    """The numbers of the <custom><numeric> of that name; none if the file has no such element."""
    index = mujoco.mj_name2id(m, Kind.mjOBJ_NUMERIC, name)
    return m.numeric_data[m.numeric_adr[index] :][: m.numeric_size[index]] if index >= 0 else np.zeros(0)


def floating(m: mujoco.MjModel) -> bool:
    """Whether the robot has a free joint."""
    return bool((m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())


def motors(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """(actuators,) whose force is their control times a constant."""
    still, unbiased = m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE, m.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE
    return still & unbiased & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)


def servos(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """(actuators,) whose force besides is a spring and a damper on what they move: <position>, <velocity>."""
    still, affine = m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE, m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    return still & affine & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)


def control_range(m: mujoco.MjModel) -> tuple[Array, Array]:
    """(nu,) lowest and highest control of each actuator, for which actions of -1 and 1 stand."""
    tendon, limited = m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, m.actuator_ctrllimited != 0
    low = np.where(limited, m.actuator_ctrlrange[:, 0], np.where(tendon, 0.0, -1.0))
    return low, np.where(limited, m.actuator_ctrlrange[:, 1], 1.0)


def disabled_flags(m: mujoco.MjModel) -> set[str]:
    """Names of <flag> that the file disables."""
    return _set_bits(mujoco.mjtDisableBit.__members__, "mjDSBL_", m.opt.disableflags)


def enabled_flags(m: mujoco.MjModel) -> set[str]:
    """Names of <flag> that the file enables and that are not so by default."""
    return _set_bits(mujoco.mjtEnableBit.__members__, "mjENBL_", m.opt.enableflags)


def _set_bits(bits: Mapping[str, int], prefix: str, flags: int) -> set[str]:
    names = [name for name, bit in bits.items() if name.startswith(prefix) and flags & int(bit)]
    return {name.removeprefix(prefix).lower() for name in names}


# Which geoms touch ----------------------------------------------------------------------------------------------------


class PairLaw(NamedTuple):
    """A contact between two geoms, by MuJoCo's rules for what the two ask for."""

    condim: int
    friction: float
    solref: tuple[float, float]
    solimp: tuple[float, ...] = ()


def ground_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """(fixed geom, moving geom) that may touch; what is part of the robot's own base is no ground."""
    weld = m.body_weldid[m.geom_bodyid]
    moving, ground = np.flatnonzero(weld), np.flatnonzero((weld == 0) & ~base_geoms(m))
    pairs = {(s, g): None for s in ground.tolist() for g in moving[_collide(m, s, moving)].tolist()}
    sides = {(s, g): None for pair in declared_pairs(m) for s, g in (pair, pair[::-1]) if weld[g] and s in ground}
    return list(pairs | sides)


def base_geoms(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """(ngeom,) of bodies that are fixed to the world and carry moving ones, planes and height fields aside."""
    carries = np.isin(m.body_rootid, m.body_rootid[m.body_weldid > 0])
    flat = (m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) | (m.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
    return carries[m.geom_bodyid] & (m.body_weldid[m.geom_bodyid] == 0) & (m.geom_bodyid > 0) & ~flat


def declared_pairs(m: mujoco.MjModel) -> dict[tuple[int, int], int]:
    """The <pair> of two geoms, the lower one first, where the file has one."""
    if disabled_flags(m) & {"constraint", "contact"}:
        return {}
    ends = np.sort(np.column_stack((m.pair_geom1, m.pair_geom2)), axis=1).tolist()
    return {(a, b): k for k, (a, b) in enumerate(ends)}


def self_pairs(m: mujoco.MjModel) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """The robot's geoms, each with the later ones of other bodies that it may touch."""
    weld = m.body_weldid[m.geom_bodyid]
    parent = m.body_weldid[m.body_parentid[weld]]
    filters = "filterparent" not in disabled_flags(m)
    parts = np.flatnonzero((weld > 0) | base_geoms(m))
    declared = [pair for pair in declared_pairs(m) if np.isin(pair, parts).all()]
    for k, a in enumerate(parts.tolist()):
        b = parts[k + 1 :]
        related = ((parent[a] == weld[b]) | (parent[b] == weld[a])) & (weld[a] > 0) & (weld[b] > 0)
        touch = (weld[a] != weld[b]) & ~(filters & related) & _collide(m, a, b)
        if len(b := b[touch | np.isin(b, [second for first, second in declared if first == a])]):
            yield a, b


def _collide(m: mujoco.MjModel, a: int, b: NDArray[np.int64]) -> NDArray[np.bool_]:
    masks = (m.geom_contype[a] & m.geom_conaffinity[b]) | (m.geom_contype[b] & m.geom_conaffinity[a])
    bodies = m.geom_bodyid[a], m.geom_bodyid[b]
    excluded = np.isin((np.minimum(*bodies) << 16) + np.maximum(*bodies), m.exclude_signature)
    return (masks != 0) & ~excluded


def pair_law(m: mujoco.MjModel, a: int, b: int) -> PairLaw:
    """The geom of higher priority decides; of equals friction and condim are the larger, solref and solimp the mean.

    A <pair> of the two has its own numbers.
    """
    if (pair := declared_pairs(m).get((min(a, b), max(a, b)))) is not None:
        first, second = m.pair_solref[pair].tolist()
        return PairLaw(
            int(m.pair_dim[pair]), float(m.pair_friction[pair, 0]), (first, second), tuple(m.pair_solimp[pair])
        )
    geoms = [a, b]
    if m.geom_priority[a] != m.geom_priority[b]:
        geoms = [a if m.geom_priority[a] > m.geom_priority[b] else b] * 2
    solref, weight = m.geom_solref[geoms], m.geom_solmix[geoms]
    weights = weight if weight.min() >= 0 and 0 < weight.sum() < np.inf else None
    if geoms[0] == geoms[1] or not (solref[:, 0] > 0).all():
        mixed = solref.min(0)
    else:
        mixed = np.average(solref, axis=0, weights=weights)
    solimp = np.average(m.geom_solimp[geoms], axis=0, weights=weights)
    friction = float(m.geom_friction[geoms, 0].max())
    condim = int(m.geom_condim[geoms].max())
    return PairLaw(condim, friction, (float(mixed[0]), float(mixed[1])), tuple(solimp.tolist()))


def contact_points(m: mujoco.MjModel, geom: int) -> tuple[Array, float]:
    """(n, 3) centres, in the geom's frame, of the spheres that touch in its place, and their radius."""
    kind, size = mujoco.mjtGeom(m.geom_type[geom]), m.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _spread(_hull(m, m.geom_dataid[geom])), 0.0
    points = POINTS[int(kind)]
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return points * size[1], float(size[0])
    return points * (size[[0, 0, 1]] if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else size), 0.0


def _hull(m: mujoco.MjModel, mesh: int) -> Array:
    """(n, 3) corners of a mesh's convex hull, or all of its vertices where MuJoCo has made no hull."""
    vertices: Array = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]].astype(float)
    if m.mesh_graphadr[mesh] < 0:
        return vertices
    graph = m.mesh_graph[m.mesh_graphadr[mesh] :]  # counts of corners and faces, where edges begin, then the corners
    return vertices[graph[2 + graph[0] :][: graph[0]]]


def _spread(points: Array) -> Array:
    """At most HULL_POINTS of them: the extremes along each axis, then each time the farthest from all before."""
    chosen = list(dict.fromkeys([*points.argmin(0).tolist(), *points.argmax(0).tolist()]))
    distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(1)
    while len(chosen) < HULL_POINTS and distance.max() > 0.02 * np.ptp(points, axis=0).max():
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


# Constants ------------------------------------------------------------------------------------------------------------


class Recovery(NamedTuple):
    """A constraint's return to zero, per unit of inertia."""

    stiffness: float  # 1/s^2
    damping: float  # 1/s

    @property
    def damping_ratio(self) -> float:
        return self.damping / (2 * np.sqrt(FIRMNESS * self.stiffness)) if self.stiffness > 0 else 0.0


def asked(solref: Sequence[float] | Array) -> Recovery:
    """FIRMNESS times what solref asks for; infinite beyond what a number holds."""
    first, second = map(float, solref)
    if first > 0:
        square = (first * second) ** 2
        return Recovery(FIRMNESS / square if square > 0 else np.inf, FIRMNESS * 2 / first)
    return Recovery(-FIRMNESS * first, -FIRMNESS * second)  # MuJoCo's direct format


def recovery(solref: Sequence[float] | Array) -> Recovery:
    """What solref asks for, but no faster than a substep can follow: the idea of MuJoCo's flag refsafe."""
    stiffness, damping = asked(solref)
    return Recovery(min(stiffness, 1 / (2 * STEP) ** 2), min(damping, 1 / STEP))


def contact_constants(mass: float, mobility: Array, solref: Sequence[float]) -> dict[str, float]:
    """k_n, k_d and k_t of a robot's mass [kg], the mobility (points,) [1/kg] of its contact points, and their solref.

    k_n carries its share of the mass as solref asks, but never more than the lightest point stays stable on; k_t halves
    that point's slip in one substep.
    """
    rates = recovery(solref)
    lightest = min(mass, 1 / mobility.max()) if mobility.any() else mass  # kg
    k_n = min(mass * rates.stiffness / min(CARRIERS, len(mobility)), 0.1 * lightest / STEP**2)
    return {"k_n": float(k_n), "k_d": float(REBOUND * rates.damping_ratio * k_n), "k_t": lightest / (2 * STEP)}


def limit_constants(m: mujoco.MjModel) -> tuple[Array, Array]:
    """k_limit, d_limit (nv,): what solreflimit asks for, times the inertia that the joint moves."""
    inertia = 1 / np.diag(np.linalg.inv(mass_matrix(m)))
    rates = [recovery(m.jnt_solref[joint]) for joint in m.dof_jntid]
    k_limit: Array = inertia * np.array([rate.stiffness for rate in rates])
    return k_limit, LIMIT_REBOUND * k_limit * np.array([rate.damping_ratio for rate in rates])


def at_rest(m: mujoco.MjModel) -> mujoco.MjData:
    """Where everything is in the reference pose."""
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    return data


def mass_matrix(m: mujoco.MjModel) -> Array:
    """(nv, nv) in the reference pose, as all inertias here; armature included."""
    data = at_rest(m)
    mujoco.mj_makeM(m, data)
    matrix = np.eye(m.nv)
    for row, unit in zip(matrix, np.eye(m.nv), strict=True):
        mujoco.mj_mulM(m, data, row, unit)
    return matrix


def mobilities(m: mujoco.MjModel, points: Sequence[tuple[int, Array]]) -> Array:
    """(points,) 1/kg: acceleration per force of points (body, world position), in the direction of least inertia."""
    data = at_rest(m)
    jacobians = np.zeros((len(points), 3, m.nv))
    for jacobian, (body, position) in zip(jacobians, points, strict=True):
        mujoco.mj_jac(m, data, jacobian, None, position, body)
    response = jacobians @ np.linalg.inv(mass_matrix(m)) @ jacobians.transpose(0, 2, 1)
    return np.linalg.eigvalsh(response)[:, -1]

"""Contacts of a robot: pairs of geoms, their parameters, their contact points, and the slip of these on the ground."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.elements import disabled_flags
from diffsim.robot.types import Array

HULL_POINTS = 16  # of a mesh, at most
_CORNERS = np.array([[x, y, z] for y in (-1, 1) for x in (-1, 1) for z in (-1, 1)], float)
_RIM = np.array([[np.cos(turn), np.sin(turn), z] for z in (-1, 1) for turn in np.arange(8) * np.pi / 4])
# Contact points of a geom by its type, along its axes in half lengths; a mesh has its own
POINTS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): np.zeros((1, 3)),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
    int(mujoco.mjtGeom.mjGEOM_BOX): _CORNERS,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _RIM,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): np.concatenate((np.eye(3), -np.eye(3), _CORNERS / np.sqrt(3))),
    int(mujoco.mjtGeom.mjGEOM_MESH): np.zeros((HULL_POINTS, 3)),
}
UNBOUNDED = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "HFIELD", "SDF")]


class PairLaw(NamedTuple):
    """Parameters of a contact between two geoms, mixed by MuJoCo's rules."""

    condim: int
    friction: float
    solref: Array  # (2,)
    solimp: Array  # (5,)
    margin: float  # m, distance at which the contact begins


def ground_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """List (ground, moving geom) that may touch; fixed geoms of bounded shapes are no ground (robot/pairs.py)."""
    weld = m.body_weldid[m.geom_bodyid]
    moving, ground = np.flatnonzero(weld), np.flatnonzero((weld == 0) & np.isin(m.geom_type, UNBOUNDED))
    pairs = {(s, g): None for s in ground.tolist() for g in moving[collide(m, s, moving)].tolist()}
    sides = {(s, g): None for pair in declared_pairs(m) for s, g in (pair, pair[::-1]) if weld[g] and s in ground}
    return list(pairs | sides)


def base_geoms(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark geoms (ngeom,) of bodies fixed to the world with moving children, without unbounded ones."""
    carries = np.isin(m.body_rootid, m.body_rootid[m.body_weldid > 0])
    fixed = (m.body_weldid[m.geom_bodyid] == 0) & ~np.isin(m.geom_type, UNBOUNDED)
    return carries[m.geom_bodyid] & (m.geom_bodyid > 0) & fixed


def declared_pairs(m: mujoco.MjModel) -> dict[tuple[int, int], int]:
    """Map two geoms, the lower one first, to their <pair> in the file."""
    if disabled_flags(m) & {"constraint", "contact"}:
        return {}
    ends = np.sort(np.column_stack((m.pair_geom1, m.pair_geom2)), axis=1).tolist()
    return {(a, b): k for k, (a, b) in enumerate(ends)}


def collide(m: mujoco.MjModel, a: int, b: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which geoms b the masks and exclusions of the file let touch geom a."""
    masks = (m.geom_contype[a] & m.geom_conaffinity[b]) | (m.geom_contype[b] & m.geom_conaffinity[a])
    bodies = m.geom_bodyid[a], m.geom_bodyid[b]
    excluded = np.isin((np.minimum(*bodies) << 16) + np.maximum(*bodies), m.exclude_signature)
    return (masks != 0) & ~excluded


def pair_law(m: mujoco.MjModel, a: int, b: int) -> PairLaw:
    """Mix the parameters of two geoms as MuJoCo does.

    The geom of higher priority decides. Of equal ones friction and condim are the larger, solref and solimp the mean.
    A <pair> of the two has its own parameters.
    """
    if (pair := declared_pairs(m).get((min(a, b), max(a, b)))) is not None:
        margin = m.pair_margin[pair] - (0.0 if _margins_add() else m.pair_gap[pair])
        friction = float(m.pair_friction[pair, 0])
        return PairLaw(int(m.pair_dim[pair]), friction, m.pair_solref[pair], m.pair_solimp[pair], float(margin))
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
    margin, gap = m.geom_margin[[a, b]], m.geom_gap[[a, b]]
    begins = margin.sum() if not margin.any() or _margins_add() else margin.max() - gap.max()
    return PairLaw(int(m.geom_condim[geoms].max()), friction, mixed, solimp, float(begins))


@cache
def _margins_add() -> bool:
    """Tell whether this MuJoCo adds the margins of two geoms; older versions take the larger one, less the gap."""
    geom = '<geom type="{}" size="1 1 1" margin="1"/>'
    body = f"<body><freejoint/>{geom.format('sphere')}</body>"
    m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom.format('plane')}{body}</worldbody></mujoco>")
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    return bool(data.contact[0].includemargin > 1.5)


def contact_points(m: mujoco.MjModel, geom: int) -> tuple[Array, float]:
    """Return the centres (n, 3), in the geom's frame, of the spheres that stand for it, and their radius."""
    kind, size = mujoco.mjtGeom(m.geom_type[geom]), m.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _spread(hull(m, m.geom_dataid[geom])), 0.0
    points = POINTS[int(kind)]
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return points * size[1], float(size[0])
    return points * (size[[0, 0, 1]] if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else size), 0.0


def matrix_of(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion wxyz."""
    mujoco.mju_quat2Mat(result := np.zeros(9), np.asarray(quaternion, float))
    return result.reshape(3, 3)


def hull(m: mujoco.MjModel, mesh: int) -> Array:
    """Return the vertices (n, 3) of a mesh's convex hull, or all of its vertices if MuJoCo has made no hull."""
    vertices: Array = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]].astype(float)
    if m.mesh_graphadr[mesh] < 0:
        return vertices
    graph = m.mesh_graph[m.mesh_graphadr[mesh] :]  # counts of corners and faces, where edges begin, then the corners
    return vertices[graph[2 + graph[0] :][: graph[0]]]


def _spread(points: Array) -> Array:
    """Choose at most HULL_POINTS: the extremes along each axis, then repeatedly the farthest from all before."""
    chosen = list(dict.fromkeys([*points.argmin(0).tolist(), *points.argmax(0).tolist()]))
    distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(1)
    while len(chosen) < HULL_POINTS and distance.max() > 0.02 * np.ptp(points, axis=0).max():
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]

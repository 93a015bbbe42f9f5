"""Shapes that touch each other: spheres, capsules and boxes, which stand for the other shapes of a file."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.contacts import UNBOUNDED, base_geoms, hull, matrix_of
from diffsim.robot.types import Array

_Geom = mujoco.mjtGeom
SHAPES = [int(getattr(_Geom, f"mjGEOM_{name}")) for name in ("ELLIPSOID", "CYLINDER", "MESH")]  # made others
DIRECTIONS = 2000  # in which shapes are measured
ROUND = 0.8  # thickness over width from which on a capsule may stand for a shape


def obstacle_geoms(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark fixed geoms (ngeom,) of bounded shapes that are no part of the robot's base, such as a step of stairs."""
    return (m.body_weldid[m.geom_bodyid] == 0) & ~base_geoms(m) & ~np.isin(m.geom_type, UNBOUNDED)


def is_exact(m: mujoco.MjModel, a: int, b: int) -> bool:
    """Tell whether two geoms touch each other in their own shapes."""
    return not np.isin(m.geom_type[[a, b]], SHAPES).any()


def as_primitives(m: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy whose geoms have the shapes that touch each other here: a capsule or a box in place of SHAPES.

    A capsule has the length of its geom's bounding box, and its mean width. The bounding box itself stands for an
    obstacle that is not about as thick as wide, such as a plate or a disc, on which a robot may step, or if its surface
    is clearly nearer to the shape's: pairs with a box cost more.
    """
    fitted, fixed = copy.copy(m), obstacle_geoms(m)
    for geom in np.flatnonzero(np.isin(m.geom_type, SHAPES)).tolist():
        _fit(m, fitted, geom, boxed=False)
        if fixed[geom]:
            difference, (thick, wide, _) = deviation(m, fitted, geom), np.sort(m.geom_aabb[geom, 3:])
            _fit(m, fitted, geom, boxed=True)
            if thick > ROUND * wide and deviation(m, fitted, geom) > 0.95 * difference:
                _fit(m, fitted, geom, boxed=False)
    return fitted


def _fit(m: mujoco.MjModel, fitted: mujoco.MjModel, geom: int, boxed: bool) -> None:
    """Give a geom of the other model its bounding box or a capsule, or a sphere if that box is a cube."""
    (centre, half), turn = np.split(m.geom_aabb[geom], 2), np.zeros(4)
    kind, size, bound, along = _Geom.mjGEOM_BOX, half, np.linalg.norm(half), 2
    if not boxed:
        along = int(half.argmax())
        radius, bound = np.delete(half, along).mean(), half[along]
        kind = _Geom.mjGEOM_CAPSULE if bound > radius else _Geom.mjGEOM_SPHERE
        size, half = np.array([radius, bound - radius, 0.0]), np.array([radius, radius, bound])
    mujoco.mju_quatZ2Vec(turn, np.eye(3)[along])
    mujoco.mju_mulPose(fitted.geom_pos[geom], fitted.geom_quat[geom], m.geom_pos[geom], m.geom_quat[geom], centre, turn)
    fitted.geom_type[geom], fitted.geom_size[geom], fitted.geom_rbound[geom] = kind, size, bound
    fitted.geom_aabb[geom], fitted.geom_sameframe[geom] = [0.0, 0.0, 0.0, *half], 0


def deviation(m: mujoco.MjModel, other: mujoco.MjModel, geom: int) -> float:
    """Return the largest distance [m] between the surfaces of a geom's convex hulls in two models."""
    return float(abs(reach(m, geom) - reach(other, geom)).max())


def directions() -> Array:
    """Return unit vectors (DIRECTIONS, 3) that are spread evenly."""
    turn, z = np.pi * (3 - 5**0.5) * np.arange(DIRECTIONS), 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    level = np.sqrt(1 - z**2)
    return np.stack((level * np.cos(turn), level * np.sin(turn), z), 1)


def reach(m: mujoco.MjModel, geom: int) -> Array:
    """Return how far [m] a shape reaches in each direction (DIRECTIONS,) from the origin of its body's frame."""
    (a, b, c), kind = m.geom_size[geom], m.geom_type[geom]
    along = directions() @ matrix_of(m.geom_quat[geom])
    x, y, z = abs(along.T)
    reaches = {
        int(_Geom.mjGEOM_SPHERE): a + 0 * z,
        int(_Geom.mjGEOM_CAPSULE): a + b * z,
        int(_Geom.mjGEOM_CYLINDER): a * np.hypot(x, y) + b * z,
        int(_Geom.mjGEOM_BOX): a * x + b * y + c * z,
        int(_Geom.mjGEOM_ELLIPSOID): np.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2),
    }
    corners = hull(m, m.geom_dataid[geom]) if kind == _Geom.mjGEOM_MESH else np.zeros((1, 3))
    return reaches.get(int(kind), (along @ corners.T).max(1)) + directions() @ m.geom_pos[geom]

"""Coefficients of a fluid's drag on links, see kernels/laws/drag.py."""

from __future__ import annotations

import numpy as np

from diffsim.robot.scene import Scene
from diffsim.robot.types import Array


def drag(scene: Scene) -> tuple[Array, Array, Array, Array]:
    """Compute the fluid's drag on each link by MuJoCo's inertia-box law; see kernels/laws/drag.py for its form.

    Returns:
        principal axes (nlink, 3, 3) in the link's frame; the viscous coefficients (nlink, 3) of force and torque,
        then 0; the pressure coefficients of force and of torque (nlink, 3) each, per principal axis.
    """
    moments, axes = np.linalg.eigh(scene.inertia)
    mass = np.where(scene.mass > 0, scene.mass, np.inf)[:, None]
    # The sides of the box of uniform density that has this inertia
    sides = np.sqrt(np.maximum(moments.sum(1, keepdims=True) - 2 * moments, 0.0) * 6 / mass)
    diameter, (x, y, z) = sides.mean(1), sides.T
    viscous = np.pi * scene.viscosity * np.stack((3 * diameter, diameter**3, 0 * diameter), 1)
    force = 0.5 * scene.density * np.stack((y * z, x * z, x * y), 1)
    torque = scene.density / 64 * np.stack((x * (y**4 + z**4), y * (x**4 + z**4), z * (x**4 + y**4)), 1)
    return axes, viscous, force, torque

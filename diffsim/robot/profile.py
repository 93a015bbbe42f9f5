"""Check the vertices of a terrain, see Scene.with_terrain."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


class TerrainError(ValueError):
    """Raised for an invalid terrain, or one that the robot cannot have."""


def check_terrain(vertices: ArrayLike) -> NDArray[np.float64]:
    """Return profiles (M, K, 2) in float64, M = 1 for a single one; raises TerrainError if they are invalid."""
    try:
        profiles = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TerrainError("terrain must be numbers in an array (K, 2) or (environments, K, 2)") from error
    shape = profiles.shape
    profiles = profiles[None] if len(shape) == 2 else profiles
    if profiles.ndim != 3 or profiles.shape[2] != 2 or profiles.shape[1] < 2 or not len(profiles):
        raise TerrainError(f"terrain has shape {shape}, must be (K, 2) or (environments, K, 2) with K of 2 or more")
    with np.errstate(invalid="ignore"):
        along, up = np.moveaxis(np.diff(profiles, axis=1), 2, 0)
    wall = (along == 0) & (up != 0)
    wall[:, [0, -1]] = False  # it would go on for ever
    wall[:, 1:] &= along[:, :-1] > 0
    for good, must in (
        ((np.abs(profiles) <= np.finfo(np.float32).max).all(2), "be finite"),
        ((along > 0) | wall, "have a smaller x than the next one, or begin a wall, one alone and not at an end"),
    ):
        if not good.all():
            row, vertex = np.argwhere(~good)[0]
            where = f" of environment {row}" if len(profiles) > 1 else ""
            x, z = profiles[row, vertex]
            raise TerrainError(f"terrain: vertex {vertex}{where} ({x:g}, {z:g}) must {must}")
    return profiles

"""Terrain in pictures: boxes whose upper faces are the segments of a profile."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from diffsim.robot.scene import Array

DRAWN_END, DRAWN_SIZE = 50.0, (5.0, 0.05)  # m: of an endless segment; half width and half thickness of all


class Slab(NamedTuple):
    """A box that shows a segment: half sizes (3,), centre (3,), rotation (3, 3) with the normal as third column."""

    size: Array
    centre: Array
    rotation: Array


def slabs(profile: Array) -> list[Slab]:
    """What is drawn of a profile (K, 2): each segment is the upper face of a box, the first and the last a long one."""
    result = []
    for k, (start, end) in enumerate(itertools.pairwise(profile)):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        if k == 0:
            start, length = start - DRAWN_END * along, length + DRAWN_END
        if k == len(profile) - 2:
            length += DRAWN_END
        t, n = np.array([along[0], 0.0, along[1]]), np.array([-along[1], 0.0, along[0]])
        size = np.array([length / 2, *DRAWN_SIZE])
        centre = np.array([start[0], 0.0, start[1]]) + size[0] * t - size[2] * n
        result.append(Slab(size, centre, np.stack([t, [0.0, 1.0, 0.0], n], 1)))
    return result

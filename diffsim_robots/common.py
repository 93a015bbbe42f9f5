"""Terms and disturbances that the tasks of robots with servos share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import reduce

import torch
from torch import Tensor

FREQUENCY_OF_PUSHES = 0.25  # 1/s


def score(square: Tensor, scale: float) -> Tensor:
    """Return log(1 + square / scale): a parabola near 0 that keeps a slope far away but does not dominate."""
    return torch.log1p(square / scale)


def add_up(terms: Mapping[str, Tensor], order: Iterable[tuple[str, ...]]) -> Tensor:
    """Return the sum of terms (...): those of a tuple are added first; where one is missing, the others.

    Another order would change the last bits of rewards, and so the policies that are trained by a seed.
    """
    sums = (reduce(torch.add, [terms[name] for name in names if name in terms]) for names in order)
    return reduce(torch.add, sums)


def push(noise: Tensor, sizes: tuple[float, float], control_dt: float) -> Tensor:
    """Draw the change (..., 2) [m/s] of the root's horizontal velocity by a random push, 0 if none is due.

    Args:
        noise: (..., 3) uniform in [0, 1); 0.5 is no push.
        sizes: the least and the largest, m/s.
        control_dt: s, in which one comes with FREQUENCY_OF_PUSHES.
    """
    due, size, way = noise.split(1, dim=-1)
    (least, most), way = sizes, 2.0 * math.pi * way
    size = (least + (most - least) * size) * (due < control_dt * FREQUENCY_OF_PUSHES)
    return size * torch.cat((way.cos(), way.sin()), dim=-1)

"""Which geoms MuJoCo lets touch which, and what it would make of the contact."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray


class PairLaw(NamedTuple):
    """Of a contact between two geoms, by MuJoCo's rules for what the two ask for."""

    condim: int
    friction: float
    solref: tuple[float, float]


def ground_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """(fixed geom, moving geom) that may touch."""
    weld = m.body_weldid[m.geom_bodyid]
    moving = np.flatnonzero(weld).tolist()
    return [(s, g) for s in np.flatnonzero(weld == 0).tolist() for g in moving if _collide(m, s, g)]


def self_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """Moving geoms of two bodies that may touch each other."""
    weld = m.body_weldid[m.geom_bodyid]
    parent = m.body_weldid[m.body_parentid[weld]]
    filters = "filterparent" not in disabled_flags(m)
    return [
        (a, b)
        for a, b in combinations(np.flatnonzero(weld).tolist(), 2)
        if weld[a] != weld[b] and not (filters and (parent[a] == weld[b] or parent[b] == weld[a])) and _collide(m, a, b)
    ]


def pair_law(m: mujoco.MjModel, a: int, b: int) -> PairLaw:
    """The geom of higher priority decides; of equals friction and condim are the larger, solref is the mean."""
    if m.geom_priority[a] != m.geom_priority[b]:
        first = a if m.geom_priority[a] > m.geom_priority[b] else b
        return PairLaw(int(m.geom_condim[first]), float(m.geom_friction[first, 0]), _two(m.geom_solref[first]))
    solref, weight = m.geom_solref[[a, b]], m.geom_solmix[[a, b]]
    if (solref[:, 0] > 0).all():
        mixed = np.average(solref, axis=0, weights=weight if weight.any() else None)
    else:
        mixed = solref.min(0)
    return PairLaw(int(m.geom_condim[[a, b]].max()), float(m.geom_friction[[a, b], 0].max()), _two(mixed))


def disabled_flags(m: mujoco.MjModel) -> set[str]:
    """Names of <flag> that the file disables."""
    return _set_bits(mujoco.mjtDisableBit.__members__, "mjDSBL_", m.opt.disableflags)


def enabled_flags(m: mujoco.MjModel) -> set[str]:
    """Names of <flag> that the file enables and that are not so by default."""
    return _set_bits(mujoco.mjtEnableBit.__members__, "mjENBL_", m.opt.enableflags)


def _set_bits(bits: Mapping[str, int], prefix: str, flags: int) -> set[str]:
    names = [name for name, bit in bits.items() if name.startswith(prefix) and flags & int(bit)]
    return {name.removeprefix(prefix).lower() for name in names}


def _collide(m: mujoco.MjModel, a: int, b: int) -> bool:
    masks = m.geom_contype[a] & m.geom_conaffinity[b] or m.geom_contype[b] & m.geom_conaffinity[a]
    low, high = sorted((m.geom_bodyid[a], m.geom_bodyid[b]))
    return bool(masks) and (int(low) << 16) + int(high) not in m.exclude_signature


def _two(solref: NDArray[np.float64]) -> tuple[float, float]:
    return float(solref[0]), float(solref[1])

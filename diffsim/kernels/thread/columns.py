"""Columns of the gradients by a scene's constants (kernels/parameters.py): which constants, and where each group is."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

# Columns of each link: mass, first moments (3) and moments of inertia xx, yy, zz, xy, xz, yz; of each joint, in its
# link's row, those named below; of each motor gear and bias; of each contact with the ground, and then of each block of
# rows between bodies (pairs/), friction and the logarithm of its weight.
LINK, JOINT, MOTOR, CONTACT = 10, 6, 2, 2
ARMATURE, DAMPING, LOSS, WEIGHT, STIFFNESS, SERVO_DAMPING = range(JOINT)


class Columns(NamedTuple):
    """Where the columns of each group begin, in this order, and where the last ones end."""

    links: int
    joints: int
    motors: int
    ground: int
    pairs: int
    end: int

    @staticmethod
    def of(nlink: int, nu: int, ncontact: int, npairs: int) -> Columns:
        """Lay out the columns of these numbers of links, motors, contacts with the ground and blocks of rows."""
        sizes = LINK * nlink, JOINT * nlink, MOTOR * nu, CONTACT * ncontact, CONTACT * npairs
        return Columns(*accumulate(sizes, initial=0))

"""Types that the files of a robot share: below Scene, which is made of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int32]

JOINT, POINT, TURN, GEOMS = range(4)  # kinds of blocks, see kernels/pairs/rows.py
NAMES = "joint", "point", "turn", "geoms"
# Kinds of two geoms: parallel capsules, spheres and capsules, a sphere and a box, a capsule and a box, two boxes
PARALLEL, SEGMENTS, BALL_BOX, CAPSULE_BOX, BOXES = range(-1, 4)
CONTACTS = {PARALLEL: 2, SEGMENTS: 1, BALL_BOX: 1, CAPSULE_BOX: 2, BOXES: 8}  # at most, of a pair
FEATURES = {
    PARALLEL: "parallel_geoms",
    BALL_BOX: "ball_box_geoms",
    CAPSULE_BOX: "capsule_box_geoms",
    BOXES: "box_geoms",
}
LEAST_ROOM, MOST_ROOM = 64, 512  # for contacts of pairs at once, in the environments that a thread steps together
ROOM_OF_TREE = 8  # contacts at once, in a scene of many trees of bodies


class SceneError(ValueError):
    """Raised for an MJCF file that is missing, broken or not supported; names the element."""


class Transmissions(NamedTuple):
    """Actuators on fixed tendons and at sites, for kernels/transmission.py."""

    tendon: Index  # (nt,) actuators on fixed tendons
    law: Array  # (nt, 4) stiffness [N/m] and damping [N s/m] by the tendon's length, then the bounds of the force [N]
    begin: Index  # (nt + 1,) of each tendon in the two that follow
    link: Index  # (nj,) its joints' links
    coef: Array  # (nj,) the tendon's change of length by each joint's position, times the actuator's gear
    chain: Index  # (1,) the tendon with damping along a chain of joints, -1 if none
    site: Index  # (ns,) actuators at sites
    site_link: Index  # (ns,) the links that they push
    torque: Array  # (ns, 3) m, per force of the actuator, about the link's origin and in the link's frame
    force: Array  # (ns, 3) the same of the force

    def features(self, constrained: bool, explicit: bool) -> frozenset[str]:
        """Return the features of these actuators with MuJoCo's constraints or not, whose damping may be explicit."""
        present = {
            "tendon": len(self.tendon),
            "site": len(self.site),
            "tendon_damping": bool(self.law[:, 1].any()) and not explicit,
            "tendon_chain": self.chain[0] >= 0 and constrained and not explicit,
        }
        return frozenset(name for name, used in present.items() if used)


class PairSizes(NamedTuple):
    """Sizes that the kernels' code depends on."""

    equalities: int = 0  # number of blocks of equality, which come first
    heads: int = 0  # number of these and of the first ones of two geoms, which come next
    most: int = 1  # contacts of two geoms, at most
    places: int = 0  # number of points of blocks, see Pairs.places
    blocks: int = 0  # number of blocks in local arrays, of which the last ones are room for those of two geoms

    @property
    def last(self) -> int:
        """Return the first element of that room."""
        return self.blocks - self.most


class Pairs(NamedTuple):
    """Blocks of three rows between two bodies, each with two ends; BLANK (pairs.py) where a kind has no number."""

    kind: Index  # (n,)
    partner: Index  # (n,) the other block of a weld, the second one of two geoms, or itself
    params: Array  # (n, 11) as Constraints.contact
    link: Index  # (n, 2) of each end, -1 for the world beside a floating base
    point: Array  # (n, 2, 3) m, in the link's frame
    frame: Array  # (n, 2, 3, 3) orientation in the link's frame
    ref: Array  # (n, 2) q_0 of a joint
    polycoef: Array  # (n, 5) of a joint
    torquescale: Array  # (n,) of a turn
    size: Array  # (n, 2, 3) m, of a geom as MuJoCo's
    touch: Index  # (n,) kind of two geoms
    contacts: Index  # (n,) how many two geoms may have, 0 in all their blocks but the first
    reach_sq: Array  # (n,) m^2, square of the distance of two geoms' centres within which they may touch

    @property
    def features(self) -> frozenset[str]:
        """Return the names of the kinds that are there, for Scene.features."""
        kinds = set(self.touch[self.kind == GEOMS].tolist())
        rows = frozenset(f"{NAMES[kind]}_rows" for kind in self.kind.tolist())
        return rows | {name for kind, name in FEATURES.items() if kind in kinds}

    @property
    def geom_pairs(self) -> NDArray[np.int64]:
        """Return which pair of geoms each block is of that belongs to one."""
        contacts = self.contacts[self.contacts > 0]
        heads = np.arange(len(contacts))
        return np.r_[heads, heads.repeat(contacts - 1)]

    @property
    def places(self) -> tuple[Array, NDArray[np.int64]]:
        """Return each point once, its link before its coordinates (m, 4), and which ones are a block's (n, 2)."""
        all_of = np.concatenate((self.link[..., None], self.point), 2)
        places, which = np.unique(all_of.reshape(-1, 4), axis=0, return_inverse=True)
        return places, which.reshape(-1, 2)

    def sizes(self, room: int) -> PairSizes:
        """Return sizes of the kernels' arrays, with room for so many contacts at once."""
        equalities, number = int((self.kind != GEOMS).sum()), len(self.kind)
        heads, most = equalities + int((self.contacts > 0).sum()), int(self.contacts.max(initial=1))
        return PairSizes(equalities, heads, most, len(self.places[0]), min(number, equalities + room) + most)


class Constraints(NamedTuple):
    """Parameters of MuJoCo's constraints, for one length of a substep."""

    # (nc, 11) k [1/s^2] and b [1/s]; friction; 1 / impratio; inverse weight [1/kg]; the impedance's ends, width [m],
    # midpoint and power; margin [m]
    contact: Array
    axis: Array  # (nc, 3) see Spheres
    limit: Array  # (nlink, 11) the same of each joint, in its units; friction and impratio are of no use
    loss: Array  # (nlink, 3) of each joint's dry friction: its bound [N or N m], D [kg or kg m^2] and b [1/s]
    pairs: Pairs | None = None  # rows between two bodies, see robot/pairs.py
    room: int = LEAST_ROOM  # for contacts of pairs at once

    @property
    def pair_sizes(self) -> PairSizes:
        """Return sizes of the kernels' arrays for the rows between two bodies."""
        return self.pairs.sizes(self.room) if self.pairs else PairSizes()

    @property
    def rough(self) -> bool:
        """Tell whether a contact has friction."""
        return bool(self.contact[:, 2].any() or (self.pairs and self.pairs.params[self.pairs.kind == GEOMS, 2].any()))

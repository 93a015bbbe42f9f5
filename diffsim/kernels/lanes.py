"""Several GPU threads for one environment.

One thread per environment leaves a GPU waiting: a substep is ten thousand instructions, most of which wait for the one
before, and 64 environments keep 64 of its thousands of cores busy. So a few neighbouring threads, `lanes`, share an
environment. Each simulates a tree of its own: the trunk, which all have, and some limbs; where limbs have much to do,
several lanes, `sharers`, have the same ones. Masses, contact spheres and muscles are dealt out among the lanes that
have their links. Poses and velocities need no exchange. On the way in, each lane's inertias and forces are a summand of
the true ones: they are added up over the sharers before the sweep, and over the limbs where it reaches the trunk. A
butterfly adds the same numbers in the same tree on every lane: what lanes have in common stays equal to the last bit.
"""

import dataclasses
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from diffsim.scene import Scene

SPHERE = 0.5  # what a contact sphere or a muscle costs, in links


@dataclasses.dataclass(frozen=True)
class Lanes:
    """Who computes what.

    Attributes:
        sharers: neighbouring lanes that have the same limbs.
        trunk: number of links, without the base, that all lanes have.
        links: of each lane, the links that it simulates, in the order of the tree: the base, the trunk, its limbs.
        weighs, spheres, muscles: of each lane, the links whose mass it carries, its contact spheres and its muscles.
            Each is dealt to one lane.
    """

    sharers: int
    trunk: int
    links: list[list[int]]
    weighs: list[list[int]]
    spheres: list[list[int]]
    muscles: list[list[int]]

    @property
    def slots(self) -> int:
        return max(map(len, self.links))


def divide(scene: Scene, lanes: int = 1, sharers: int = 1) -> Lanes:
    """Deals a scene's tree to lanes so that none gets many links.

    The trunk starts as the base and grows into the longest limb for as long as that can help. A muscle must find both
    ends of each of its segments on one lane.

    Args:
        scene: the tree.
        lanes: threads of an environment, a power of two.
        sharers: how many of them have the same limbs, a power of two that divides lanes.
    """
    parent, ball, groups = scene.parent, scene.ball, lanes // sharers
    below: list[list[int]] = [[] for _ in range(scene.nlink)]  # the subtree of each link
    for i in reversed(range(scene.nlink)):
        below[i] = sorted([i] + [k for child in np.flatnonzero(parent[1:] == i) + 1 for k in below[child]])
    pulled = np.unique(scene.segment_muscle).tolist()  # the other actuators are motors, which go with their links
    ends = [{0} | set(scene.segment_link[scene.segment_muscle == k].flatten()) for k in pulled]
    trunk, limbs = [0], [below[i] for i in range(1, scene.nlink) if parent[i] == 0]
    best = [list(range(scene.nlink))] * groups, scene.nlink - 1
    while limbs:
        dealt = [list(trunk) for _ in range(groups)]
        for limb in sorted(limbs, key=len, reverse=True):
            min(dealt, key=len).extend(limb)
        reachable = all(any(e <= set(links) for links in dealt) for e in ends)
        if reachable and max(map(len, dealt)) < max(map(len, best[0])):
            best = [sorted(trunk) + sorted(links[len(trunk) :]) for links in dealt], len(trunk) - 1
        longest = max(limbs, key=len)
        root = longest[: 3 if ball[longest[0]] == 0 else 1]  # a ball joint's links stay together
        limbs.remove(longest)
        trunk += root
        limbs += [below[i] for i in longest if i not in root and parent[i] in root]
    links = [best[0][lane // sharers] for lane in range(lanes)]

    cost = np.zeros(lanes)

    def deal(needs: list[set[int]], price: float) -> list[list[int]]:
        hands: list[list[int]] = [[] for _ in range(lanes)]
        # Things that few lanes can have go first.
        for k in sorted(range(len(needs)), key=lambda k: sum(needs[k] <= set(row) for row in links)):
            lane = min((lane for lane in range(lanes) if needs[k] <= set(links[lane])), key=lambda lane: cost[lane])
            hands[lane].append(k)
            cost[lane] += price
        return [sorted(hand) for hand in hands]

    muscles = [[pulled[k] for k in hand] for hand in deal(ends, SPHERE)]
    spheres = deal([{int(i)} for i in scene.contact_link], SPHERE)
    weighs = deal([{i} for i in range(scene.nlink)], 1.0)
    return Lanes(sharers, best[1], links, weighs, spheres, muscles)


@cache
def lane_sums(dtype: type, lanes: int, sharers: int) -> SimpleNamespace:
    """Sums over the lanes of an environment; all of its lanes must call them together."""
    T, vec6, mat3 = dtype, wp.types.vector(6, dtype), wp.types.matrix((3, 3), dtype)
    neighbour = f"""
#if defined(__CUDA_ARCH__)
    const unsigned first = (threadIdx.x & 31u) & ~({lanes}u - 1u);
    return __shfl_xor_sync({2**lanes - 1}u << first, value, offset);
#else
    return value;
#endif
"""

    @wp.func_native(neighbour)
    def of_neighbour(value: T, offset: int) -> T: ...

    def sums(offsets: tuple[int, ...]) -> SimpleNamespace:
        steps, least = len(offsets), offsets[0] if offsets else 1

        @wp.func
        def add(value: T):
            for k in range(steps):
                value = value + of_neighbour(value, least << k)
            return value

        @wp.func
        def add_vec6(value: vec6):
            for k in range(6):
                value[k] = add(value[k])
            return value

        @wp.func
        def add_mat3(value: mat3):
            for r in range(3):
                for c in range(3):
                    value[r, c] = add(value[r, c])
            return value

        return SimpleNamespace(add=add, add_vec6=add_vec6, add_mat3=add_mat3)

    powers = [2**k for k in range(lanes.bit_length() - 1)]
    return SimpleNamespace(
        all=sums(tuple(powers)),
        sharers=sums(tuple(p for p in powers if p < sharers)),
        limbs=sums(tuple(p for p in powers if p >= sharers)),
    )

"""Division of one environment among several GPU threads.

One thread per environment leaves a GPU idle: a substep is ten thousand instructions, most of which depend on the one
before, and 64 environments use 64 of its thousands of cores. So a few neighbouring threads of a CUDA warp, here called
lanes, may share an environment. Each lane simulates a tree of its own: the trunk, which all lanes have, and some limbs.
If limbs are expensive, several lanes, the `sharers`, have the same limbs. Masses, contact spheres and muscles are
distributed among the lanes that have their links.

Poses and velocities need no exchange. In the inward sweep, each lane's inertias and forces are a summand of the true
ones, which exchange.py sums: over the sharers before the sweep, and over the limbs when the sweep reaches the trunk.

On a CPU, an environment has one lane, which has all links.
"""

import dataclasses

import numpy as np

from diffsim.robot.scene import Scene

SPHERE = 0.5  # cost of a contact sphere or a muscle, in links
POWERS = (1, 2, 4, 8, 16)


@dataclasses.dataclass(frozen=True)
class Division:
    """A division of one environment's links, masses, contact spheres and muscles among its lanes."""

    threads_per_env: int  # number of lanes
    sharers: int  # neighbouring lanes that have the same limbs
    trunk: int  # number of links, without the base, that all lanes have
    links: list[list[int]]  # that each lane simulates, in the tree's order: the base, the trunk, its limbs
    masses: list[list[int]]  # links whose mass each lane owns; a mass is on one lane
    spheres: list[list[int]]  # contact spheres of each lane; a sphere is on one lane
    muscles: list[list[int]]  # muscles of each lane; a muscle is on one lane

    @property
    def slots(self) -> int:
        """Return the largest number of links on a lane."""
        return max(map(len, self.links))


def divide(scene: Scene, threads_per_env: int = 1, sharers: int = 1) -> Division:
    """Distribute the links evenly over lanes, all links of a muscle on one lane.

    Raises:
        ValueError: numbers of lanes or of sharers that are not powers of two up to 16, or more sharers than lanes.
    """
    if threads_per_env not in POWERS or sharers not in POWERS or sharers > threads_per_env:
        raise ValueError(
            f"threads_per_env is {threads_per_env!r} and sharers {sharers!r}: both must be one of "
            f"{', '.join(map(str, POWERS))}, and sharers not the larger one"
        )
    if threads_per_env > 1 and scene.indivisible:
        what = scene.indivisible
        raise ValueError(f"threads_per_env is {threads_per_env}, must be 1 with {what}")
    pulled = np.unique(scene.segment_muscle).tolist()  # the other actuators are motors, on the lanes of their links
    ends = [{0} | set(scene.segment_link[scene.segment_muscle == k].flatten()) for k in pulled]
    trunk, groups = distribute_limbs(scene, threads_per_env // sharers, ends)
    links = [groups[lane // sharers] for lane in range(threads_per_env)]
    cost = np.zeros(threads_per_env)

    def distribute(needs: list[set[int]], price: float) -> list[list[int]]:
        shares: list[list[int]] = [[] for _ in links]
        # Elements that few lanes can have go first.
        for k in sorted(range(len(needs)), key=lambda k: sum(needs[k] <= set(row) for row in links)):
            eligible = [lane for lane, row in enumerate(links) if needs[k] <= set(row)]
            lane = min(eligible, key=lambda lane: cost[lane])
            shares[lane].append(k)
            cost[lane] += price
        return [sorted(share) for share in shares]

    muscles = [[pulled[k] for k in share] for share in distribute(ends, SPHERE)]
    spheres = distribute([{int(i)} for i in scene.contact_link], SPHERE)
    masses = distribute([{i} for i in range(scene.nlink)], 1.0)
    return Division(threads_per_env, sharers, trunk, links, masses, spheres, muscles)


def distribute_limbs(scene: Scene, groups: int, ends: list[set[int]]) -> tuple[int, list[list[int]]]:
    """Divide the tree into a trunk and the limbs of each group of lanes.

    The trunk starts as the base and grows into the longest limb as long as that can help. Each of `ends`, sets of
    links, must be on one group.

    Returns:
        number of links of the trunk, without the base; links of each group.
    """
    parent, ball = scene.parent, scene.ball
    below: list[list[int]] = [[] for _ in range(scene.nlink)]  # the subtree of each link
    for i in reversed(range(scene.nlink)):
        below[i] = sorted([i] + [k for child in np.flatnonzero(parent[1:] == i) + 1 for k in below[child]])
    trunk, limbs = [0], [below[i] for i in range(1, scene.nlink) if parent[i] == 0]
    best = scene.nlink - 1, [list(range(scene.nlink))] * groups
    while limbs:
        shares = [list(trunk) for _ in range(groups)]
        for limb in sorted(limbs, key=len, reverse=True):
            min(shares, key=len).extend(limb)
        reachable = all(any(e <= set(links) for links in shares) for e in ends)
        if reachable and max(map(len, shares)) < max(map(len, best[1])):
            best = len(trunk) - 1, [sorted(trunk) + sorted(links[len(trunk) :]) for links in shares]
        longest = max(limbs, key=len)
        root = longest[: 3 if ball[longest[0]] == 0 else 1]  # a ball joint's links stay together
        limbs.remove(longest)
        trunk += root
        limbs += [below[i] for i in longest if i not in root and parent[i] in root]
    return best

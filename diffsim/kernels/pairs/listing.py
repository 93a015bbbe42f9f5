"""Lists the rows between two bodies that act in a substep, and places them (rows.py).

Two geoms have as many blocks of rows as they may have contacts, whose first one comes with the other pairs' first ones
and stands for all of them until their bounding spheres meet. If there is no room for all, the deepest ones are kept.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.ground import UNSOLVED
from diffsim.kernels.pairs.equality import equality_rows
from diffsim.kernels.pairs.geoms import pair_geoms
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def pair_list(spec: KernelSpec, adjoint: bool) -> SimpleNamespace:
    """Make the functions that place and list blocks of rows, with or without what only their adjoint needs."""
    t, sp, block, equality, sizes = types(spec), spatial(spec), blocks(spec), equality_rows(spec), spec.pair_sizes
    T, U, vec3, Model, Lane, Links, Contacts = t.T, t.U, t.vec3, t.Model, t.Lane, t.Links, t.Contacts
    FLOATING, WORLD, BLOCK, (TOUCH, TREES) = spec.floating, spec.room - 1, spec.block, spec.has("geoms_rows trees")
    EQUALITIES, HEADS, PLACES, LAST = sizes.equalities, sizes.heads, sizes.places, sizes.last
    geoms = pair_geoms(spec, adjoint) if TOUCH else None

    @wp.func
    def place_world(links: Links, origin: vec3):
        """Place the world, beside a floating base about which all else is."""
        if wp.static(FLOATING):
            links[WORLD].R = wp.identity(3, dtype=T)
            links[WORLD].x = -origin

    @wp.func
    def depth_of(c: int, contacts: Contacts):
        """Return a contact's depth in the environment of a block where it is deepest."""
        depth = U(0.0)
        for k in range(BLOCK):
            depth = wp.max(depth, block.element(-contacts[c].r * contacts[c].active, k))
        return depth

    @wp.func
    def keep(here: Lane, c: int, end: int, contacts: Contacts):
        """List contact c, in place of the one that is least deep if there is no room for both; returns the end."""
        last = here.begin + LAST
        if end < last:
            if c > end:
                contacts[end] = contacts[c]
            return end + 1
        least = int(c)
        depth = depth_of(c, contacts)
        for k in range(here.begin + EQUALITIES, last):
            other = depth_of(k, contacts)
            if other < depth:
                depth = other
                least = k
        contacts[last].D = contacts[last].D + T(UNSOLVED) * contacts[least].active
        if least != c:
            contacts[least] = contacts[c]
        return end

    @wp.func
    def list_blocks(m: Model, here: Lane, links: Links, contacts: Contacts):
        """List and place the blocks that act, of equality all, of geoms those near each other; returns their end.

        The element after the last one has a D if there is no room for all.
        """
        end = here.begin
        last = here.begin + LAST
        contacts[last].D = T(0.0)
        equalities = int(EQUALITIES)  # not unrolled
        heads = int(HEADS)
        places = int(PLACES)
        for s in range(equalities):
            contacts[end].row = s
            equality.place(m, end, links, contacts)
            end = end + 1
        if wp.static(TOUCH):
            centres = wp.zeros(shape=PLACES, dtype=vec3)
            if wp.static(TREES):
                origins = wp.zeros(shape=PLACES, dtype=vec3)
            for k in range(places):
                i = m.place_link[k]
                centres[k] = sp.on_link(links[i].R, links[i].x, m.place_point[k])
                if wp.static(TREES):
                    origins[k] = links[i].origin
                    if i == 0:  # a fixed point, which may be as far away
                        origins[k] = centres[k]
                        centres[k] = vec3()
            for s in range(equalities, heads):
                d = centres[m.row_place[2 * s + 1]] - centres[m.row_place[2 * s]]
                if wp.static(TREES):
                    d = d + (origins[m.row_place[2 * s + 1]] - origins[m.row_place[2 * s]])
                near = T(m.row_reach_sq[s]) - wp.dot(d, d)  # of their bounding spheres
                if block.any_of(near):
                    begin = end
                    number = geoms.place(m, s, near, end, links, contacts)
                    for k in range(number):
                        if block.any_of(contacts[begin + k].active):
                            end = keep(here, begin + k, end, contacts)
        return end

    return functions(locals())

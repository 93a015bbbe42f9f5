"""Lists the rows between two bodies that act in a substep, and places them (pairs.py).

Two geoms have as many blocks of rows as they may have contacts, whose first one comes with the other pairs' first ones
and stands for all of them until their bounding spheres meet. If there is no room for all, the deepest ones are kept.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.ground import UNSOLVED
from diffsim.kernels.pairs.boxes import box_contacts
from diffsim.kernels.pairs.capsules import capsule_contacts
from diffsim.kernels.pairs.geometry import pair_geometry
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.pairs import BOXES, CAPSULE_BOX, PARALLEL


@cache
def pair_list(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions that place and list blocks of rows."""
    t, sp, block, geometry, sizes = types(spec), spatial(spec), blocks(spec), pair_geometry(spec), spec.pair_sizes
    T, U, vec3, Model, Lane, Links, Contacts = t.T, t.U, t.vec3, t.Model, t.Lane, t.Links, t.Contacts
    FLOATING, WORLD, BLOCK, TOUCH = spec.floating, spec.room - 1, spec.block, "geoms_rows" in spec.features
    EQUALITIES, HEADS, NPOINTS, LAST = sizes.equalities, sizes.heads, sizes.points, sizes.last
    PARALLELS, CAPSULE_BOXES, TWO_BOXES = spec.has("parallel_geoms capsule_box_geoms box_geoms")
    capsules = capsule_contacts(spec) if PARALLELS or CAPSULE_BOXES else None
    boxes = box_contacts(spec) if TWO_BOXES else None

    @wp.func
    def place_world(links: Links, origin: vec3):
        """Place the world, beside a floating base about which all else is."""
        if wp.static(FLOATING):
            links[WORLD].R = wp.identity(3, dtype=T)
            links[WORLD].x = -origin

    @wp.func
    def place_contacts(m: Model, s: int, end: int, links: Links, contacts: Contacts):
        """Place the contacts of the two geoms with the first row s in the elements from `end` on; returns how many."""
        number = int(1)
        contacts[end].row = s
        kind = m.row_shape[s][9]
        if wp.static(TWO_BOXES):
            if kind == U(BOXES):
                number = boxes.place_boxes(m, s, end, links, contacts)
        if wp.static(PARALLELS):
            if kind == U(PARALLEL):
                number = int(2)
                capsules.place_parallel(m, s, end, links, contacts)
        if wp.static(CAPSULE_BOXES):
            if kind == U(CAPSULE_BOX):
                number = capsules.place_capsule_box(m, s, end, links, contacts)
        if m.row_partner[s] == s:
            geometry.place_touch(m, s, end, geometry.nearest_points(m, s, links), contacts)
        for k in range(1, number):
            contacts[end + k].row = m.row_partner[s] + k - 1
        return number

    @wp.func
    def contact_adjoint(m: Model, c: int, links: Links, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the adjoint of the second link's pose beside a first one that stays, as a wrench.

        Those of the contact's point are g_p, of its distance g_r, of its normal n g_n. It moves rigidly with both links
        together, so that the first one's wrench follows (pair_adjoint.py).
        """
        kind = m.row_shape[contacts[c].row][9]
        if wp.static(TWO_BOXES):
            if kind == U(BOXES):
                return boxes.boxes_adjoint(m, c, contacts, n, g_p, g_r, g_n)
        if wp.static(PARALLELS):
            if kind == U(PARALLEL):
                return capsules.parallel_adjoint(m, c, links, contacts, n, g_p, g_r, g_n)
        if wp.static(CAPSULE_BOXES):
            if kind == U(CAPSULE_BOX):
                return capsules.capsule_box_adjoint(m, c, links, contacts, n, g_p, g_r, g_n)
        s = contacts[c].row
        return geometry.touch_adjoint(m, s, links, geometry.nearest_points(m, s, links), n, g_p, g_r, g_n)

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
        points = int(NPOINTS)
        for s in range(equalities):
            contacts[end].row = s
            geometry.place(m, end, links, contacts)
            end = end + 1
        if wp.static(TOUCH):
            centres = wp.zeros(shape=NPOINTS, dtype=vec3)
            for k in range(points):
                i = m.point_link[k]
                centres[k] = sp.on_link(links[i].R, links[i].x, m.point[k])
            for s in range(equalities, heads):
                d = centres[m.row_points[2 * s + 1]] - centres[m.row_points[2 * s]]
                if block.any_of(T(m.row_shape[s][0]) - wp.dot(d, d)):  # of their bounding spheres
                    begin = end
                    number = place_contacts(m, s, end, links, contacts)
                    for k in range(number):
                        if block.any_of(contacts[begin + k].active):
                            end = keep(here, begin + k, end, contacts)
        return end

    return functions(locals())

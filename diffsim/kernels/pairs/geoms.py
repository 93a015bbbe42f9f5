"""Contacts of two geoms: reads both from the model, finds their contacts in each environment, and places these.

The functions of geometry are those of one environment (spheres.py, capsules.py, boxes.py). A block of environments has
them called in turn: each one returns as early as it can, and an environment whose geoms are far apart is left out.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.boxes import box_contacts
from diffsim.kernels.pairs.capsules import capsule_contacts
from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.pairs.spheres import sphere_contacts
from diffsim.kernels.pairs.touch import geom_types
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.types import BALL_BOX, BOXES, CAPSULE_BOX, PARALLEL


@cache
def pair_geoms(spec: KernelSpec, adjoint: bool) -> SimpleNamespace:
    """Make the functions that place contacts of two geoms, with or without what only their adjoint needs."""
    t, one, block, J = types(spec), geom_types(spec.dtype), blocks(spec), pair_jacobian(spec)
    T, U, vec3, vec4, mat3, Model, Links, Contacts = t.T, t.U, t.vec3, t.vec4, t.mat3, t.Model, t.Links, t.Contacts
    size3, Geom, Touch, Touches = one.vec3, one.Geom, one.Touch, one.Touches
    pick, element, with_element = block.pick, block.element, block.with_element
    BLOCK, MOST, TREES = spec.block, spec.pair_sizes.most, "trees" in spec.features
    spheres, capsules, boxes = (make(U) for make in (sphere_contacts, capsule_contacts, box_contacts))
    PARALLELS, BALLS, CAPSULE_BOXES, TWO_BOXES = spec.has("parallel_geoms ball_box_geoms capsule_box_geoms box_geoms")

    @wp.func
    def frame_of(m: Model, end: int, links: Links):
        """Return the orientation of a geom."""
        return links[m.row_link[end]].R * mat3(m.row_frame[end])

    @wp.func
    def contact_frame(n: vec3):
        """Return MuJoCo's frame (t_1, t_2, n) of a contact with the normal n, and n.y and |y - n n.y|."""
        across = pick(wp.abs(n[1]), T(0.5), T(1.0), T(0.0))
        y = vec3(T(0.0), across, T(1.0) - across)
        along = wp.dot(n, y)
        t1 = y - along * n
        size = wp.length(t1)
        t1 = t1 / size
        t2 = wp.cross(n, t1)
        return mat3(t1[0], t2[0], n[0], t1[1], t2[1], n[1], t1[2], t2[2], n[2]), along, size

    @wp.func
    def normal_of(c: int, contacts: Contacts):
        frame = contacts[c].E
        return vec3(frame[0, 2], frame[1, 2], frame[2, 2])

    @wp.func
    def geom_at(x: vec3, R: mat3, size: size3, k: int):
        """Return a geom in environment k of the block."""
        geom = Geom()
        for i in range(3):
            geom.x[i] = element(x[i], k)
            for j in range(3):
                geom.R[i, j] = element(R[i, j], k)
        geom.size = size
        return geom

    @wp.func
    def collide(kind: int, first: Geom, second: Geom, margin: U, found: Touches):
        """Find the contacts of two geoms, a kind of robot/types.py, in one environment; returns their number."""
        if wp.static(TWO_BOXES):
            if kind == BOXES:
                return boxes.box_box(first, second, margin, found)
        if wp.static(CAPSULE_BOXES):
            if kind == CAPSULE_BOX:
                return capsules.capsule_box(first, second, margin, found)
        if wp.static(PARALLELS):
            if kind == PARALLEL:
                return spheres.capsule_capsule(first, second, found)
        if wp.static(BALLS):
            if kind == BALL_BOX:
                found[0] = spheres.sphere_box(first.x, first.size[0], second)
                return 1
        found[0] = spheres.segment_segment(first, second)
        return 1

    @wp.func
    def clear(c: int, contacts: Contacts):
        """Empty a contact, so that environments without it compute with finite numbers."""
        contacts[c].active = T(0.0)
        contacts[c].r = T(0.0)
        contacts[c].p = vec3()
        contacts[c].E = wp.identity(3, dtype=T)
        if wp.static(adjoint):
            contacts[c].how = vec4()
        if wp.static(adjoint and MOST > 1):
            contacts[c].z = vec3()
            contacts[c].a = vec3()
            contacts[c].b = vec3()

    @wp.func
    def write(c: int, k: int, touch: Touch, margin: U, contacts: Contacts):
        """Write a contact to environment k of block c, all but the tangents of its frame."""
        r = touch.dist - margin
        contacts[c].r = with_element(contacts[c].r, k, r)
        if r < U(0.0):
            contacts[c].active = with_element(contacts[c].active, k, U(1.0))
        for i in range(3):
            contacts[c].p[i] = with_element(contacts[c].p[i], k, touch.p[i])
            contacts[c].E[i, 2] = with_element(contacts[c].E[i, 2], k, touch.n[i])
        if wp.static(adjoint):
            for i in range(4):
                contacts[c].how[i] = with_element(contacts[c].how[i], k, touch.how[i])
        if wp.static(adjoint and MOST > 1):
            for i in range(3):
                contacts[c].z[i] = with_element(contacts[c].z[i], k, touch.z[i])
                contacts[c].a[i] = with_element(contacts[c].a[i], k, touch.a[i])
                contacts[c].b[i] = with_element(contacts[c].b[i], k, touch.b[i])

    @wp.func
    def place(m: Model, s: int, near: T, end: int, links: Links, contacts: Contacts):
        """Place the contacts of the geoms with the first block s, where near > 0, in the elements from `end` on.

        Their points are about the origin of J.reference. Returns the most that an environment has.
        """
        about = J.reference(m, s)
        x1 = J.point_about(m, 2 * s, about, links)
        R1 = frame_of(m, 2 * s, links)
        x2 = J.point_about(m, 2 * s + 1, about, links)
        R2 = frame_of(m, 2 * s + 1, links)
        margin = m.row_params[s][10]
        found = wp.zeros(shape=MOST, dtype=Touch)
        number = int(0)
        for c in range(MOST):
            clear(end + c, contacts)
        for k in range(BLOCK):
            if element(near, k) > U(0.0):
                first = geom_at(x1, R1, m.row_size[2 * s], k)
                second = geom_at(x2, R2, m.row_size[2 * s + 1], k)
                count = collide(m.row_touch[s], first, second, margin, found)
                for c in range(count):
                    write(end + c, k, found[c], margin, contacts)
                number = wp.max(number, count)
        for c in range(number):
            contacts[end + c].row = m.row_partner[s] + c - 1
            contacts[end + c].q = contacts[end + c].p
            if wp.static(TREES):
                contacts[end + c].q = contacts[end + c].p + J.offset(about, m.row_link[2 * s], links)
            E, along, size = contact_frame(normal_of(end + c, contacts))
            contacts[end + c].E = E
        contacts[end].row = s
        return number

    return functions(locals())

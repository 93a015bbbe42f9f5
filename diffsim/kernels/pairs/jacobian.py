"""J of a block of three rows between the links i (first) and j (second), and its transpose.

Points of both links, each about the origin of its own tree (kinematics.py), have J a = E' (a_j - a_i), with E the frame
of the contact of two geoms, or the world's for a POINT (equality.py). A TURN has E' (A_j - A_i) of the angular
accelerations, a JOINT the accelerations of both joints.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.robot.types import JOINT, TURN


@cache
def pair_jacobian(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of J."""
    t, sp = types(spec), spatial(spec)
    T, vec3, vec6, Model, Links, Contacts = t.T, t.vec3, t.vec6, t.Model, t.Links, t.Contacts
    force_at, point_velocity, TREES = sp.force_at, sp.point_velocity, "trees" in spec.features

    @wp.func
    def ends(m: Model, s: int):
        """Return the slots of a block's two links."""
        return m.row_link[2 * s], m.row_link[2 * s + 1]

    @wp.func
    def reference(m: Model, s: int):
        """Return the link about whose origin a block's ends are compared: the second, or the first if that is fixed."""
        i, j = ends(m, s)
        return wp.where(j > 0, j, i)

    @wp.func
    def offset(i: int, r: int, links: Links):
        """Return the origin of link i about that of link r."""
        if wp.static(TREES):
            return links[i].origin - links[r].origin
        return vec3()

    @wp.func
    def point_about(m: Model, end: int, r: int, links: Links):
        """Return the place of a block's point, on the link of that end, about the origin of link r."""
        i = m.row_link[end]
        p = sp.on_link(links[i].R, links[i].x, m.row_point[end])
        if wp.static(TREES):  # of a fixed point p is large, and only the sum is small
            p = p + offset(i, r, links)
        return p

    @wp.func
    def rates(m: Model, c: int, contacts: Contacts, first: vec6, second: vec6, first_rate: T, second_rate: T):
        """Return the rows' velocities of twists of both links and rates of their joints: J times those."""
        s = contacts[c].row
        v = vec3()
        if m.row_kind[s] == JOINT:
            v[0] = second_rate - contacts[c].slope * first_rate
        elif m.row_kind[s] == TURN:
            v = wp.transpose(contacts[c].E) * (wp.spatial_top(second) - wp.spatial_top(first))
        else:
            v = point_velocity(second, contacts[c].p) - point_velocity(first, contacts[c].q)
            v = wp.transpose(contacts[c].E) * v
        return v

    @wp.func
    def wrenches(m: Model, c: int, contacts: Contacts, f: vec3):
        """Return the wrench of the rows' forces f on the second link, and minus that on the first; 0 of a joint's."""
        s = contacts[c].row
        world = contacts[c].E * f
        second = vec6()
        first = vec6()
        if m.row_kind[s] == TURN:
            second = sp.join(world, vec3())
            first = second
        elif m.row_kind[s] != JOINT:
            second = force_at(contacts[c].p, world)
            first = force_at(contacts[c].q, world)
        return first, second

    return functions(locals())

"""The geometry of rows between two bodies (pairs.py): points, frames and violations of blocks of three rows.

A block's `kind` tells what its rows are, between the links i (first) and j (second):

    JOINT    q_j - q_j0 - poly(q_i - q_i0) of two joints, or of one; the other two rows are empty
    POINT    a point of j less one of i: <connect>, or a <weld>'s translation
    TURN     the vector part of the quaternion (w, v) of j relative to i, times `torquescale`: a <weld>'s rotation

J maps the links' twists to E' (A_j - A_i): accelerations of the points for POINT, angular ones for TURN, where
E' x = torquescale / 2 (w x + x x v) in the frame of i. MuJoCo adds dJ/dt v, the `drift`, to J a of POINT and TURN.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import functions, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.robot.pairs import JOINT, POINT, TURN

LEAST = 1e-12  # of 4 w^2, at a rotation by half a turn


@cache
def pair_geometry(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a block's geometry: its points, frame and violation, and their adjoint."""
    t, sp = types(spec), spatial(spec)
    T, vec3, vec6, mat3 = t.T, t.vec3, t.vec6, t.mat3
    Model, Links, Contacts, force_at, point_velocity = t.Model, t.Links, t.Contacts, sp.force_at, sp.point_velocity
    FIRST = max(spec.spheres, 1)  # the first block's element of contacts
    JOINTS, POINTS, TURNS = spec.has("joint_rows point_rows turn_rows")

    @wp.func
    def turn_of(m: Model, s: int, links: Links):
        """Return w and the vector part of the quaternion of j relative to i, and the frame of i."""
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        R = links[i].R * mat3(m.row_first_frame[s])
        Q = wp.transpose(R) * (links[j].R * mat3(m.row_second_frame[s]))
        w = T(0.5) * wp.sqrt(wp.max(T(1.0) + wp.trace(Q), T(LEAST)))
        v = vec3(Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]) / (T(4.0) * w)
        return w, v, R

    @wp.func
    def turn_motion(R: mat3, V_first: vec6, V_second: vec6, first: vec6, second: vec6):
        """Return the angular velocity of j relative to i in the frame R of i, and the derivative of those numbers."""
        own = wp.transpose(R) * wp.spatial_top(V_first)
        rate = wp.transpose(R) * wp.spatial_top(V_second - V_first)
        return rate, wp.transpose(R) * wp.spatial_top(second - first) - wp.cross(own, rate)

    @wp.func
    def polynomial(m: Model, s: int, x: T):
        """Return the value, slope and curvature of a joint's polynomial."""
        c = m.row_shape[s]
        value = T(c[6])
        slope = T(0.0)
        curvature = T(0.0)
        for k in range(4):
            curvature = curvature * x + T(2.0) * slope
            slope = slope * x + value
            value = value * x + T(c[5 - k])
        return vec3(value, slope, curvature)

    @wp.func
    def violation(m: Model, s: int, links: Links):
        """Return the violation of an equality's block."""
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        r = vec3()
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                c = m.row_shape[s]
                r[0] = links[j].q - T(c[0]) - polynomial(m, s, links[i].q - T(c[1]))[0]
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                p = sp.on_link(links[j].R, links[j].x, m.row_second[s])
                r = p - sp.on_link(links[i].R, links[i].x, m.row_first[s])
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:
                w, v, R = turn_of(m, s, links)
                r = T(m.row_shape[s][0]) * v
        return r

    @wp.func
    def place(m: Model, s: int, links: Links, contacts: Contacts):
        """Set the block's points and frame."""
        c = FIRST + s
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        contacts[c].E = wp.identity(3, dtype=T)
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                contacts[c].slope = polynomial(m, s, links[i].q - T(m.row_shape[s][1]))[1]
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                contacts[c].p = sp.on_link(links[j].R, links[j].x, m.row_second[s])
                contacts[c].q = sp.on_link(links[i].R, links[i].x, m.row_first[s])
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:  # half the rate of the quaternion's vector part
                w, v, R = turn_of(m, s, links)
                half = T(0.5) * T(m.row_shape[s][0])
                contacts[c].E = half * (R * (w * wp.identity(3, dtype=T) + wp.skew(v)))

    @wp.func
    def rates(m: Model, s: int, contacts: Contacts, first: vec6, second: vec6, first_rate: T, second_rate: T):
        """Return the rows' velocities of twists of both links and rates of their joints: J times those."""
        c = FIRST + s
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
    def point_acceleration(A: vec6, V: vec6, p: vec3):
        """Return the acceleration of a link's point, less gravity; A is spatial."""
        return point_velocity(A, p) + wp.cross(wp.spatial_top(V), point_velocity(V, p))

    @wp.func
    def drift(m: Model, s: int, links: Links, contacts: Contacts, first: vec6, second: vec6):
        """Return dJ/dt v of an equality's rows, from the links' accelerations A without those of joints."""
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        a = vec3()
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                a = point_acceleration(second, links[j].V, contacts[FIRST + s].p)
                a = a - point_acceleration(first, links[i].V, contacts[FIRST + s].q)
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:
                w, v, R = turn_of(m, s, links)
                rate, accel = turn_motion(R, links[i].V, links[j].V, first, second)
                a = T(0.5) * T(m.row_shape[s][0]) * (w * accel + wp.cross(accel, v) - (T(0.5) * wp.dot(rate, rate)) * v)
        return a

    @wp.func
    def wrenches(m: Model, s: int, contacts: Contacts, f: vec3):
        """Return the wrench of the rows' forces f on the second link, and minus that on the first; 0 of a joint's."""
        c = FIRST + s
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

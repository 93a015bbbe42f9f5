"""Equality between two bodies: violations, points and frames of its blocks of three rows.

A block's `kind` tells what its rows are, between the links i (first) and j (second):

    JOINT    q_j - q_j0 - poly(q_i - q_i0) of two joints, or of one; the other two rows are empty
    POINT    a point of j less one of i: <connect>, or a <weld>'s translation
    TURN     the vector part of the quaternion (w, v) of j relative to i, times `torquescale`: a <weld>'s rotation

E of a TURN is that of E' x = torquescale / 2 (w x + x x v) in the frame of i. MuJoCo adds dJ/dt v, the `drift`, to J a
of POINT and TURN.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.robot.types import JOINT, POINT, TURN

LEAST = 1e-12  # of 4 w^2, at a rotation by half a turn


@cache
def equality_rows(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of equality."""
    t, sp, ends = types(spec), spatial(spec), pair_jacobian(spec).ends
    T, vec3, vec6, mat3, Model, Links, Contacts = t.T, t.vec3, t.vec6, t.mat3, t.Model, t.Links, t.Contacts
    JOINTS, POINTS, TURNS = spec.has("joint_rows point_rows turn_rows")

    @wp.func
    def turn_of(m: Model, s: int, links: Links):
        """Return w and the vector part of the quaternion of j relative to i, and the frame of i."""
        i, j = ends(m, s)
        R = links[i].R * mat3(m.row_frame[2 * s])
        Q = wp.transpose(R) * (links[j].R * mat3(m.row_frame[2 * s + 1]))
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
    def polynomial(m: Model, s: int, links: Links):
        """Return the value, slope and curvature of a joint's polynomial."""
        x = links[m.row_link[2 * s]].q - T(m.row_ref[2 * s])
        c = m.row_polycoef[s]
        value = T(c[4])
        slope = T(0.0)
        curvature = T(0.0)
        for k in range(4):
            curvature = curvature * x + T(2.0) * slope
            slope = slope * x + value
            value = value * x + T(c[3 - k])
        return vec3(value, slope, curvature)

    @wp.func
    def point_of(m: Model, end: int, links: Links):
        """Return the place of a block's point, on the link of that end."""
        i = m.row_link[end]
        return sp.on_link(links[i].R, links[i].x, m.row_point[end])

    @wp.func
    def violation(m: Model, s: int, links: Links):
        """Return the violation of a block."""
        r = vec3()
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                r[0] = links[m.row_link[2 * s + 1]].q - T(m.row_ref[2 * s + 1]) - polynomial(m, s, links)[0]
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                r = point_of(m, 2 * s + 1, links) - point_of(m, 2 * s, links)
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:
                w, v, R = turn_of(m, s, links)
                r = T(m.row_torquescale[s]) * v
        return r

    @wp.func
    def place(m: Model, c: int, links: Links, contacts: Contacts):
        """Set the points and the frame of a block."""
        s = contacts[c].row
        contacts[c].E = wp.identity(3, dtype=T)
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                contacts[c].slope = polynomial(m, s, links)[1]
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                contacts[c].p = point_of(m, 2 * s + 1, links)
                contacts[c].q = point_of(m, 2 * s, links)
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:  # half the rate of the quaternion's vector part
                w, v, R = turn_of(m, s, links)
                half = T(0.5) * T(m.row_torquescale[s])
                contacts[c].E = half * (R * (w * wp.identity(3, dtype=T) + wp.skew(v)))

    @wp.func
    def point_acceleration(A: vec6, V: vec6, p: vec3):
        """Return the acceleration of a link's point, less gravity; A is spatial."""
        return sp.point_velocity(A, p) + wp.cross(wp.spatial_top(V), sp.point_velocity(V, p))

    @wp.func
    def drift(m: Model, c: int, links: Links, contacts: Contacts, first: vec6, second: vec6):
        """Return dJ/dt v of a block's rows, from the links' accelerations A without those of joints."""
        s = contacts[c].row
        i, j = ends(m, s)
        a = vec3()
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                a = point_acceleration(second, links[j].V, contacts[c].p)
                a = a - point_acceleration(first, links[i].V, contacts[c].q)
        if wp.static(TURNS):
            if m.row_kind[s] == TURN:
                w, v, R = turn_of(m, s, links)
                rate, accel = turn_motion(R, links[i].V, links[j].V, first, second)
                half = T(0.5) * T(m.row_torquescale[s])
                a = half * (w * accel + wp.cross(accel, v) - (T(0.5) * wp.dot(rate, rate)) * v)
        return a

    return functions(locals())

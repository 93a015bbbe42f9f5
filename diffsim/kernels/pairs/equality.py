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
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.types import JOINT, POINT, TURN


@cache
def equality_rows(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of equality."""
    t, sp, J = types(spec), spatial(spec), pair_jacobian(spec)
    ends = J.ends
    T, vec3, vec4, vec6, mat3, Model, Links, Contacts = (
        getattr(t, name) for name in "T vec3 vec4 vec6 mat3 Model Links Contacts".split()
    )
    pick = blocks(spec).pick
    JOINTS, POINTS, TURNS = spec.has("joint_rows point_rows turn_rows")

    @wp.func
    def turn_of(m: Model, s: int, links: Links):
        """Return w and the vector part of the quaternion of j relative to i, up to its sign, and the frame of i."""
        i, j = ends(m, s)
        R = links[i].R * mat3(m.row_frame[2 * s])
        Q = wp.transpose(R) * (links[j].R * mat3(m.row_frame[2 * s + 1]))
        # 4 (x, y, z, w) times that one of the four which is largest
        skew = vec3(Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1])
        square = T(1.0) + wp.trace(Q)
        numbers = vec4(skew[0], skew[1], skew[2], square)
        for k in range(3):
            other = T(1.0) - wp.trace(Q) + T(2.0) * Q[k, k]
            row = vec4(Q[0, k] + Q[k, 0], Q[1, k] + Q[k, 1], Q[2, k] + Q[k, 2], skew[k])
            row[k] = other
            for n in range(4):
                numbers[n] = pick(square, other, row[n], numbers[n])
            square = wp.max(square, other)
        numbers = numbers * (T(0.5) / wp.sqrt(square))
        w = numbers[3]
        v = vec3(numbers[0], numbers[1], numbers[2])
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
    def violation(m: Model, s: int, links: Links):
        """Return the violation of a block."""
        r = vec3()
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                r[0] = links[m.row_link[2 * s + 1]].q - T(m.row_ref[2 * s + 1]) - polynomial(m, s, links)[0]
        if wp.static(POINTS):
            if m.row_kind[s] == POINT:
                about = J.reference(m, s)
                r = J.point_about(m, 2 * s + 1, about, links) - J.point_about(m, 2 * s, about, links)
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
                i, j = ends(m, s)
                contacts[c].p = J.point_about(m, 2 * s + 1, j, links)
                contacts[c].q = J.point_about(m, 2 * s, i, links)
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

"""The geometry of rows between two bodies (pairs.py): points, frames and violations of blocks of three rows.

A block's `kind` tells what its rows are, between the links i (first) and j (second):

    JOINT    q_j - q_j0 - poly(q_i - q_i0) of two joints, or of one; the other two rows are empty
    POINT    a point of j less one of i: <connect>, or a <weld>'s translation
    TURN     the vector part of the quaternion (w, v) of j relative to i, times `torquescale`: a <weld>'s rotation
    GEOMS    the nearest points of two segments with radii, spheres and capsules, or of a sphere and a box, in MuJoCo's
             frame E of their contact

J maps the links' twists to E' (A_j - A_i): accelerations of the points for POINT, angular ones for TURN, where
E' x = torquescale / 2 (w x + x x v) in the frame of i. MuJoCo adds dJ/dt v, the `drift`, to J a of POINT and TURN.

A segment's points are x + s a, |s| <= 1, with a = 0 of a sphere. The derivative of their distance is that at fixed s,
where it is least or at a bound (envelope theorem). That of the points adds m a, how s moves with them: `geoms_adjoint`.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.pairs import JOINT, POINT, TURN

LEAST = 1e-12  # of 4 w^2, at a rotation by half a turn
TINY = 1e-15  # MuJoCo's, of a distance and of a determinant
# Least square of the sine between two segments for the adjoint of their nearest points, in float64 and in float32
PARALLEL = 1e-12, 1e-6


@cache
def pair_geometry(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a block's geometry: its points, frame and violation, and their adjoint."""
    t, sp = types(spec), spatial(spec)
    T, U, vec3, vec6, mat3 = t.T, t.U, t.vec3, t.vec6, t.mat3
    Model, Links, Contacts, Touch, Box = t.Model, t.Links, t.Contacts, t.Touch, t.Box
    force_at, point_velocity = sp.force_at, sp.point_velocity
    pick = blocks(spec).pick
    JOINTS, POINTS, TURNS = spec.has("joint_rows point_rows turn_rows")
    LEAST_DET = PARALLEL[int(t.U == wp.float32)]

    @wp.func
    def ends(m: Model, s: int):
        """Return the slots of a row's two links."""
        return m.row_link[2 * s], m.row_link[2 * s + 1]

    @wp.func
    def turn_of(m: Model, s: int, links: Links):
        """Return w and the vector part of the quaternion of j relative to i, and the frame of i."""
        i, j = ends(m, s)
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
        i, j = ends(m, s)
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
    def place(m: Model, c: int, links: Links, contacts: Contacts):
        """Set the points and the frame of an equality's block."""
        s = contacts[c].row
        i, j = ends(m, s)
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
    def point_acceleration(A: vec6, V: vec6, p: vec3):
        """Return the acceleration of a link's point, less gravity; A is spatial."""
        return point_velocity(A, p) + wp.cross(wp.spatial_top(V), point_velocity(V, p))

    @wp.func
    def drift(m: Model, c: int, links: Links, contacts: Contacts, first: vec6, second: vec6):
        """Return dJ/dt v of an equality's rows, from the links' accelerations A without those of joints."""
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
                a = T(0.5) * T(m.row_shape[s][0]) * (w * accel + wp.cross(accel, v) - (T(0.5) * wp.dot(rate, rate)) * v)
        return a

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

    @wp.func
    def less(a: T, b: T):
        """Return 1 where a < b, else 0."""
        return pick(a, b, T(1.0), T(0.0))

    @wp.func
    def sign(x: T):
        """Return -1 where x < 0, else 1."""
        return pick(x, T(0.0), T(-1.0), T(1.0))

    @wp.func
    def signs(v: vec3):
        return vec3(sign(v[0]), sign(v[1]), sign(v[2]))

    @wp.func
    def shifted(v: vec3):
        """Return the marks v of axes moved on to the following ones."""
        return vec3(v[2], v[0], v[1])

    @wp.func
    def largest(v: vec3):
        """Mark the axis of the largest number, the first of equal ones."""
        first = (T(1.0) - less(v[0], v[1])) * (T(1.0) - less(v[0], v[2]))
        second = (T(1.0) - first) * (T(1.0) - less(v[1], v[2]))
        return vec3(first, second, T(1.0) - first - second)

    @wp.func
    def blend(which: T, a: vec3, b: vec3):
        """Return a where which is 1, b where it is 0."""
        return vec3(pick(T(0.5), which, a[0], b[0]), pick(T(0.5), which, a[1], b[1]), pick(T(0.5), which, a[2], b[2]))

    @wp.func
    def blend_wrenches(which: T, a: vec6, b: vec6):
        """Return a where which is 1, b where it is 0, whatever the other one is."""
        result = b
        for k in range(6):
            result[k] = pick(T(0.5), which, a[k], b[k])
        return result

    @wp.func
    def has_box(m: Model, s: int):
        return m.row_shape[s][9] > U(0.0)

    @wp.func
    def segments(m: Model, s: int, links: Links):
        """Return two geoms with their centres and half axes."""
        c = m.row_shape[s]
        i, j = ends(m, s)
        touch = Touch()
        touch.x1 = sp.on_link(links[i].R, links[i].x, m.row_first[s])
        touch.x2 = sp.on_link(links[j].R, links[j].x, m.row_second[s])
        touch.a1 = links[i].R * vec3(T(c[3]), T(c[4]), T(c[5]))
        touch.a2 = links[j].R * vec3(T(c[6]), T(c[7]), T(c[8]))
        if has_box(m, s):
            touch.a2 = vec3()
        touch.side = T(1.0)
        return touch

    @wp.func
    def second_box(m: Model, s: int, links: Links):
        """Return the box that is the second of two geoms."""
        c = m.row_shape[s]
        j = m.row_link[2 * s + 1]
        box = Box()
        box.x = sp.on_link(links[j].R, links[j].x, m.row_second[s])
        box.R = links[j].R * mat3(m.row_second_frame[s])
        box.h = vec3(T(c[6]), T(c[7]), T(c[8]))
        return box

    @wp.func
    def reaches(centre: vec3, reach: T, box: Box):
        """Return more than 0 where a sphere touches a box, however large that is."""
        gap = wp.abs(wp.transpose(box.R) * (centre - box.x)) - box.h
        for k in range(3):
            gap[k] = wp.max(gap[k], T(0.0))
        return reach * reach - wp.dot(gap, gap)

    @wp.func
    def box_point(m: Model, s: int, links: Links, from_centre: vec3):
        """Find the point of a box's surface that is nearest to a sphere's centre.

        Returns:
            that point, from the box's centre; 1 for each axis of the box along which it follows the sphere, else 0; the
            box's frame; -1 if the sphere's centre is inside, else 1.
        """
        c = m.row_shape[s]
        R = links[m.row_link[2 * s + 1]].R * mat3(m.row_second_frame[s])
        y = wp.transpose(R) * from_centre
        room = vec3(T(c[6]), T(c[7]), T(c[8])) - wp.abs(y)
        least = wp.min(room[0], wp.min(room[1], room[2]))
        inside = pick(T(0.0), least, T(1.0), T(0.0))
        free = vec3()
        for k in range(3):
            free[k] = pick(T(0.0), room[k], pick(least, room[k], T(1.0), T(1.0) - inside), T(0.0))
            surface = pick(T(0.0), y[k], y[k] + room[k], y[k] - room[k])
            y[k] = pick(T(0.5), free[k], y[k], surface)
        return R * y, free, R, T(1.0) - T(2.0) * inside

    @wp.func
    def clamped(x: T):
        return wp.max(wp.min(x, T(1.0)), T(-1.0))

    @wp.func
    def nearest(x1: vec3, a1: vec3, x2: vec3, a2: vec3):
        """Return s_1 and s_2 of the nearest points, and the vector from the first one to the second."""
        ma = wp.dot(a1, a1)
        mb = wp.dot(a1, a2)
        mc = wp.dot(a2, a2)
        u = wp.dot(a1, x2 - x1)
        v = wp.dot(a2, x1 - x2)
        s1 = pick(T(0.0), ma, clamped((mc * u + mb * v) / wp.max(ma * mc - mb * mb, T(TINY))), T(0.0))
        free = (v + mb * s1) / wp.max(mc, T(TINY))
        s2 = clamped(free)
        moved = clamped((u + mb * s2) / wp.max(ma, T(TINY)))
        s1 = pick(T(0.0), wp.abs(free - s2), moved, s1)
        return s1, s2, (x2 + s2 * a2) - (x1 + s1 * a1)

    @wp.func
    def to_box(m: Model, s: int, links: Links, centre: vec3, x2: vec3):
        """Return a sphere and a box with their nearest points."""
        point, free, R, side = box_point(m, s, links, centre - x2)
        touch = Touch()
        touch.x1 = centre
        touch.x2 = x2
        touch.d = point - (centre - x2)
        touch.side = side
        return touch

    @wp.func
    def nearest_points(m: Model, s: int, links: Links):
        """Return two geoms with their nearest points."""
        touch = segments(m, s, links)
        if has_box(m, s):
            return to_box(m, s, links, touch.x1, touch.x2)
        s1, s2, d = nearest(touch.x1, touch.a1, touch.x2, touch.a2)
        touch.s1 = s1
        touch.s2 = s2
        touch.d = d
        return touch

    @wp.func
    def contact_frame(d: vec3):
        """Return MuJoCo's frame (t_1, t_2, n) of a contact with the normal n along d, and |d|, n.y and |y - n n.y|."""
        length = wp.length(d)
        n = vec3(T(1.0), T(0.0), T(0.0))
        for k in range(3):
            n[k] = pick(T(TINY), length, d[k] / length, n[k])
        across = pick(wp.abs(n[1]), T(0.5), T(1.0), T(0.0))
        y = vec3(T(0.0), across, T(1.0) - across)
        along = wp.dot(n, y)
        t1 = y - along * n
        size = wp.length(t1)
        t1 = t1 / size
        t2 = wp.cross(n, t1)
        E = mat3(t1[0], t2[0], n[0], t1[1], t2[1], n[1], t1[2], t2[2], n[2])
        return E, length, along, size

    @wp.func
    def set_normal(c: int, n: vec3, which: T, contacts: Contacts):
        """Give a contact the frame with the normal n, where `which` is 1."""
        E, length, along, size = contact_frame(n)
        for i in range(3):
            for j in range(3):
                contacts[c].E[i, j] = pick(T(0.5), which, E[i, j], contacts[c].E[i, j])

    @wp.func
    def normal_of(c: int, contacts: Contacts, g_turn: vec3):
        """Return a contact's normal, and its adjoint by that of a rotation of the frame, in the frame."""
        frame = contacts[c].E
        n = vec3(frame[0, 2], frame[1, 2], frame[2, 2])
        E, length, along, size = contact_frame(n)
        return n, E * vec3(g_turn[1], -g_turn[0] - along / size * g_turn[2], T(0.0))

    @wp.func
    def place_touch(m: Model, s: int, c: int, touch: Touch, contacts: Contacts):
        """Set point, frame, violation and activity of block c for the row s."""
        r1 = T(m.row_shape[s][1])
        r2 = T(m.row_shape[s][2])
        E, length, along, size = contact_frame(touch.side * touch.d)
        n = vec3(E[0, 2], E[1, 2], E[2, 2])
        contacts[c].E = E
        contacts[c].p = touch.x1 + touch.s1 * touch.a1 + T(0.5) * (touch.d + (r1 - r2) * n)
        contacts[c].q = contacts[c].p
        contacts[c].r = touch.side * length - r1 - r2 - T(m.row_params[s][10])
        contacts[c].active = pick(contacts[c].r, T(0.0), T(1.0), T(0.0))

    @wp.func
    def slide_adjoint(z1: vec3, d: vec3, a1: vec3, a2: vec3, free1: T, free2: T, g1: vec3, g2: vec3):
        """Return the wrench (pair_list.contact_adjoint) of the adjoints of two nearest points, z_1 and z_1 + d.

        A point is free, 1, to move along its segment with half axis a, or not, 0.
        """
        ma = pick(T(0.0), free1, wp.dot(a1, a1), T(1.0))
        mb = free1 * free2 * wp.dot(a1, a2)
        mc = pick(T(0.0), free2, wp.dot(a2, a2), T(1.0))
        q1 = free1 * wp.dot(g1, a1)
        q2 = free2 * wp.dot(g2, a2)
        inv_det = T(1.0) / wp.max(ma * mc - mb * mb, T(LEAST_DET) * ma * mc)
        m1 = free1 * (mc * q1 + mb * q2) * inv_det
        m2 = -free2 * (mb * q1 + ma * q2) * inv_det
        return force_at(z1 + d, g2 + m1 * a1 + m2 * a2) + sp.join(m2 * wp.cross(a2, d), vec3())

    @wp.func
    def touch_adjoint(m: Model, s: int, links: Links, touch: Touch, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of two nearest points, see pair_list.contact_adjoint."""
        x1, a1, a2, d = touch.x1, touch.a1, touch.a2, touch.d
        length = wp.length(d)
        half = T(0.5) * T(m.row_shape[s][1] - m.row_shape[s][2])
        g_n = g_n + half * (g_p - wp.dot(g_p, n) * n)
        g_d = pick(T(TINY), length, touch.side / length, T(0.0)) * g_n + g_r * n
        g2 = T(0.5) * g_p + g_d
        free1 = pick(wp.abs(touch.s1), T(1.0), pick(T(0.0), wp.dot(a1, a1), T(1.0), T(0.0)), T(0.0))
        free2 = pick(wp.abs(touch.s2), T(1.0), pick(T(0.0), wp.dot(a2, a2), T(1.0), T(0.0)), T(0.0))
        wrench = slide_adjoint(x1 + touch.s1 * a1, d, a1, a2, free1, free2, T(0.5) * g_p - g_d, g2)
        if has_box(m, s):  # whose point follows the sphere along its free axes
            point, free, R, found = box_point(m, s, links, x1 - touch.x2)
            wrench = wrench - force_at(x1, R * wp.cw_mul(free, wp.transpose(R) * g2))
        return wrench

    return functions(locals())

"""Contacts of two boxes, as MuJoCo's since 3.12 (pair_list.py).

Of the axes normal to a face or to an edge of each box, the separating axis test (Gottschalk, Lin and Manocha, OBBTree,
1996) finds the one along which the boxes overlap least. If that is normal to a face, the face of the other box that
opposes it is clipped to its sides, and each corner of what remains is a contact. If it is normal to two edges, these
touch in one point.

A corner of the clipped face is where three planes meet, each of one of the boxes. If their points there have the
velocities u of the box with the first face and u + v of the other one, the corner has u + P' v: with P = 1 at a corner
of the clipped face, P = 1 - m D' / m.D where its edge D meets a side with the normal m, and P = w N' / w.N where two
sides meet, w and N the normals of both faces. All are P = kept + a b', which a contact keeps for its adjoint.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.geometry import TINY, pair_geometry
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.pairs import BOXES, CONTACTS

# In float64 and in float32, as MuJoCo's
AXIS_SQ = 1e-16, 1e-7  # square of the least sine between two edges whose cross product is an axis
SLACK = 1e-13, 1e-6  # of the test for separation, in sums of the half lengths
SAME_SQ = 1e-14, 1e-10  # square of the distance between two corners, in half diagonals of the face
SKEW = 1e-6, 1e-3  # least sine between an edge and a side along which their corner slides, for the adjoint
ROUNDING = 1e-9, 1e-6  # of a corner in a face, in half lengths
EDGE_BIAS = 1e-6  # relative, by which the axis of two edges must be better than the one before
ALIAS, ALIAS_BIAS = 0.99, 0.05  # the cosine beyond which such an axis must be better than a face's by so much
CORNERS = CONTACTS[BOXES]


@cache
def box_contacts(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of two boxes' contacts."""
    t, sp, geometry, block = types(spec), spatial(spec), pair_geometry(spec), blocks(spec)
    T, vec2, vec3, vec4, mat3, pick = t.T, wp.types.vector(2, t.T), t.vec3, t.vec4, t.mat3, block.pick
    Model, Links, Contacts, Box, force_at, join = t.Model, t.Links, t.Contacts, t.Box, sp.force_at, sp.join
    less, sign, signs, shifted, largest, blend = (
        getattr(geometry, name) for name in "less sign signs shifted largest blend".split()
    )
    single = int(t.U == wp.float32)
    axis_sq, slack, same_sq, skew, rounding = (each[single] for each in (AXIS_SQ, SLACK, SAME_SQ, SKEW, ROUNDING))

    @wp.func
    def separating_axis(one: Box, other: Box, margin: T):
        """Find the axis along which two boxes overlap least.

        Returns:
            marks of the best face's axis, in the first box and in the second; 1 if two edges are better, else 0; marks
            of their axes; their common normal, to the second box; 1 if the boxes are apart, else 0.
        """
        Q = wp.transpose(one.R) * other.R
        d = wp.transpose(one.R) * (other.x - one.x)
        A = Q
        for i in range(3):
            for j in range(3):
                A[i, j] = wp.abs(Q[i, j])
        first = wp.abs(d) - one.h - A * other.h
        second = wp.abs(wp.transpose(Q) * d) - other.h - wp.transpose(A) * one.h
        w1 = largest(first)
        w2 = largest(second)
        face = wp.max(wp.dot(w1, first), wp.dot(w2, second))
        of_second = less(wp.dot(w1, first), wp.dot(w2, second))
        w1 = (T(1.0) - of_second) * w1
        w2 = of_second * w2
        best = face
        most = face
        edge = T(0.0)
        u = vec3()
        v = vec3()
        axis = vec3(T(1.0), T(0.0), T(0.0))
        for i in range(3):
            e_i = vec3()
            e_i[i] = T(1.0)
            for j in range(3):
                e_j = vec3()
                e_j[j] = T(1.0)
                n = wp.cross(e_i, Q * e_j)
                square = wp.dot(n, n)
                oblique = less(T(axis_sq), square)
                n = n / wp.sqrt(wp.max(square, T(axis_sq)))
                gap = wp.abs(wp.dot(n, d)) - wp.dot(one.h, wp.abs(n)) - wp.dot(other.h, wp.abs(wp.transpose(Q) * n))
                most = pick(T(0.5), oblique, wp.max(most, gap), most)
                better = oblique * less(best, gap - T(EDGE_BIAS) * wp.abs(gap)) * less(face, gap)
                best = pick(T(0.5), better, gap, best)
                edge = wp.max(edge, better)
                axis = blend(better, n, axis)
                u = blend(better, e_i, u)
                v = blend(better, e_j, v)
        reach = margin + T(slack) * wp.dot(one.h + other.h, vec3(T(1.0), T(1.0), T(1.0)))
        alias = less(T(ALIAS), wp.abs(wp.dot(axis, w1 + Q * w2)))
        alias = alias * less(best, face + T(ALIAS_BIAS) * wp.abs(face) + T(TINY))
        n = sign(wp.dot(axis, d)) * (one.R * axis)
        return w1, w2, edge * (T(1.0) - alias), u, v, n, less(reach, most)

    @wp.func
    def append_corner(end: int, count: T, v: vec3, a: vec3, b: vec3, kept: T, take: T, same: T, contacts: Contacts):
        """Append a corner where take is 1 and none that is listed has its place; returns their number."""
        for k in range(CORNERS):
            gap = contacts[end + k].vertex - v
            taken = less(T(float(k)), count) * less(gap[0] * gap[0] + gap[1] * gap[1], same)
            take = take * (T(1.0) - taken)
        for k in range(CORNERS):
            c = end + k
            here = take * less(wp.abs(count - T(float(k))), T(0.5))
            contacts[c].vertex = blend(here, v, contacts[c].vertex)
            contacts[c].a = blend(here, a, contacts[c].a)
            contacts[c].b = blend(here, b, contacts[c].b)
            contacts[c].how[2] = pick(T(0.5), here, kept, contacts[c].how[2])
        return count + take

    @wp.func
    def clip(end: int, centre: vec3, du: vec3, dv: vec3, hx: T, hy: T, contacts: Contacts):
        """Clip the parallelogram of half edges du, dv to the rectangle |x| < hx, |y| < hy; returns how many corners."""
        for k in range(CORNERS):
            contacts[end + k].vertex = vec3()
            contacts[end + k].a = vec3()
            contacts[end + k].b = vec3()
            contacts[end + k].how = vec4()
        same = T(same_sq) * (hx * hx + hy * hy)
        count = T(0.0)
        half = vec2(hx, hy)
        D = T(-2.0) * du
        next_D = T(-2.0) * dv
        p = centre + du + dv
        for _ in range(4):
            # the part of this edge that is inside, from t0 to t1, and the sides at its ends
            t0 = T(0.0)
            t1 = T(1.0)
            m0 = vec3()
            m1 = vec3()
            for i in range(2):
                slope = sign(D[i]) * wp.max(wp.abs(D[i]), T(1e-20))
                enter = (-sign(D[i]) * half[i] - p[i]) / slope
                leave = (sign(D[i]) * half[i] - p[i]) / slope
                side = vec3()
                side[i] = less(T(skew) * wp.length(D), wp.abs(D[i])) / slope
                m0 = blend(less(t0, enter), side, m0)
                m1 = blend(less(leave, t1), side, m1)
                t0 = wp.max(t0, enter)
                t1 = wp.min(t1, leave)
            hit = less(t0, t1)
            count = append_corner(end, count, p + t0 * D, -m0, D, T(1.0), hit, same, contacts)
            left = hit * less(t1, T(1.0))
            count = append_corner(end, count, p + t1 * D, -m1, D, T(1.0), left, same, contacts)
            p = p + D
            turned = next_D
            next_D = -D
            D = turned
        w = wp.cross(du, dv)
        up = vec3(T(0.0), T(0.0), T(1.0))
        for k in range(4):
            r = vec3(hx * T(1.0 - 2.0 * float(k % 2)), hy * T(1.0 - 2.0 * float(k // 2)), T(0.0)) - centre
            r[2] = T(0.0)
            alpha = (r[0] * dv[1] - r[1] * dv[0]) / w[2]
            beta = (du[0] * r[1] - du[1] * r[0]) / w[2]
            # of equal faces on each other, edges may be outside by rounding: then these corners are left
            inside = less(wp.max(wp.abs(alpha), wp.abs(beta)), T(1.0) + T(rounding))
            v = centre + alpha * du + beta * dv
            count = append_corner(end, count, v, w / w[2], up, T(0.0), inside, same, contacts)
        return count

    @wp.func
    def place_faces(end: int, margin: T, which: T, w: vec3, ref: Box, inc: Box, contacts: Contacts):
        """Place the contacts of the box ref's marked face; which is 1 if that is the first box, else 0."""
        N = sign(wp.dot(ref.R * w, inc.x - ref.x)) * (ref.R * w)
        w_x = shifted(w)
        w_y = shifted(w_x)
        X = ref.R * w_x
        Y = ref.R * w_y
        h_z = wp.dot(ref.h, w)
        # the face of the other box that opposes this one most
        facing = wp.transpose(inc.R) * N
        g = largest(wp.abs(facing))
        u = inc.R * wp.cw_mul(inc.h, shifted(g))
        v = inc.R * wp.cw_mul(inc.h, shifted(shifted(g)))
        o = inc.x - ref.x - sign(wp.dot(facing, g)) * (inc.R * wp.cw_mul(inc.h, g))
        centre = vec3(wp.dot(X, o), wp.dot(Y, o), wp.dot(N, o) - h_z)
        du = vec3(wp.dot(X, u), wp.dot(Y, u), wp.dot(N, u))
        dv = vec3(wp.dot(X, v), wp.dot(Y, v), wp.dot(N, v))
        count = clip(end, centre, du, dv, wp.dot(ref.h, w_x), wp.dot(ref.h, w_y), contacts)
        n = (T(2.0) * which - T(1.0)) * N
        E, length, along, size = geometry.contact_frame(n)
        for k in range(CORNERS):
            c = end + k
            corner = contacts[c].vertex
            a = contacts[c].a
            b = contacts[c].b
            place = ref.x + corner[0] * X + corner[1] * Y + (h_z + corner[2]) * N
            contacts[c].vertex = place
            contacts[c].a = a[0] * X + a[1] * Y + a[2] * N
            contacts[c].b = b[0] * X + b[1] * Y + b[2] * N
            contacts[c].how[0] = T(0.0)
            contacts[c].how[1] = which
            contacts[c].E = E
            contacts[c].p = place - (T(0.5) * corner[2]) * N
            contacts[c].r = corner[2] - margin
            contacts[c].active = less(T(float(k)), count) * less(contacts[c].r, T(0.0))

    @wp.func
    def place_edges(end: int, margin: T, which: T, n: vec3, u: vec3, v: vec3, one: Box, other: Box, contacts: Contacts):
        """Place the contact of two edges with the marked axes and the common normal n, where which is 1."""
        ones = vec3(T(1.0), T(1.0), T(1.0))
        c1 = wp.cw_mul(wp.cw_mul(signs(wp.transpose(one.R) * n), one.h), ones - u)
        c2 = wp.cw_mul(wp.cw_mul(signs(wp.transpose(other.R) * n), other.h), ones - v)
        a1 = one.R * wp.cw_mul(u, one.h)
        a2 = other.R * wp.cw_mul(v, other.h)
        x1 = one.x + one.R * c1
        s1, s2, d = geometry.nearest(x1, a1, other.x - other.R * c2, a2)
        z1 = x1 + s1 * a1
        geometry.set_normal(end, n, which, contacts)
        contacts[end].vertex = blend(which, z1, contacts[end].vertex)
        contacts[end].p = blend(which, z1 + T(0.5) * d, contacts[end].p)
        contacts[end].a = blend(which, a1, contacts[end].a)
        contacts[end].b = blend(which, a2, contacts[end].b)
        contacts[end].how[0] = which
        contacts[end].how[2] = pick(T(0.5), which, less(wp.abs(s1), T(1.0)), contacts[end].how[2])
        contacts[end].how[3] = less(wp.abs(s2), T(1.0))
        contacts[end].r = pick(T(0.5), which, wp.dot(n, d) - margin, contacts[end].r)
        contacts[end].active = pick(T(0.5), which, less(contacts[end].r, T(0.0)), contacts[end].active)
        for k in range(1, CORNERS):
            contacts[end + k].active = (T(1.0) - which) * contacts[end + k].active

    @wp.func
    def choose(which: T, one: Box, other: Box):
        """Return the first box where which is 1, else the second."""
        box = Box()
        box.x = blend(which, one.x, other.x)
        box.R = which * one.R + (T(1.0) - which) * other.R
        box.h = blend(which, one.h, other.h)
        return box

    @wp.func
    def place_boxes(m: Model, s: int, end: int, links: Links, contacts: Contacts):
        """Place the contacts of two boxes; returns how many blocks have one in some environment."""
        i = m.row_link[2 * s]
        shape = m.row_shape[s]
        one = Box()
        one.x = sp.on_link(links[i].R, links[i].x, m.row_first[s])
        one.R = links[i].R * mat3(m.row_first_frame[s])
        one.h = vec3(T(shape[3]), T(shape[4]), T(shape[5]))
        other = geometry.second_box(m, s, links)
        margin = T(m.row_params[s][10])
        near = geometry.reaches(one.x, wp.length(one.h) + margin, other)
        near = wp.min(near, geometry.reaches(other.x, wp.length(other.h) + margin, one))
        if not block.any_of(near):
            return 0
        w1, w2, edge, u, v, n, apart = separating_axis(one, other, margin)
        if not block.any_of(T(1.0) - apart):
            return 0
        which = w1[0] + w1[1] + w1[2]
        ref = choose(which, one, other)
        place_faces(end, margin, which, w1 + w2, ref, choose(T(1.0) - which, one, other), contacts)
        if block.any_of(edge):
            place_edges(end, margin, edge, n, u, v, one, other, contacts)
        for k in range(CORNERS):
            contacts[end + k].q = contacts[end + k].p
            contacts[end + k].active = (T(1.0) - apart) * contacts[end + k].active
        return CORNERS

    @wp.func
    def boxes_adjoint(m: Model, c: int, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of a contact, see pair_list.contact_adjoint."""
        how = contacts[c].how
        z = contacts[c].vertex
        a = contacts[c].a
        b = contacts[c].b
        # corners of a face
        half = T(0.5) * (contacts[c].r + T(m.row_params[contacts[c].row][10]))
        N = (T(2.0) * how[1] - T(1.0)) * n
        g_z = g_r - T(0.5) * wp.dot(N, g_p)
        g_v = g_p + g_z * N
        F = how[2] * g_v + wp.dot(b, g_v) * a
        g_N = (T(2.0) * how[1] - T(1.0)) * g_n - half * g_p
        inc = force_at(z, F)
        ref = force_at(z, g_p - F) + join(wp.cross(N, g_N), vec3())
        wrench = geometry.blend_wrenches(how[1], inc, ref)
        if block.any_of(how[0]):
            d = T(2.0) * (contacts[c].p - z)
            g_n = g_n + g_r * (d - wp.dot(d, n) * n)
            g1, g2 = T(0.5) * g_p - g_r * n, T(0.5) * g_p + g_r * n
            two = geometry.slide_adjoint(z, d, a, b, how[2], how[3], g1, g2)
            across = wp.cross(a, b)
            g_across = (sign(wp.dot(across, n)) / wp.max(wp.length(across), T(TINY))) * (g_n - wp.dot(g_n, n) * n)
            two = two + join(wp.cross(b, wp.cross(g_across, a)), vec3())
            wrench = geometry.blend_wrenches(how[0], two, wrench)
        return wrench

    return functions(locals())

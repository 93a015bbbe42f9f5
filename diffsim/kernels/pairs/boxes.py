"""Contacts of two boxes of one environment, as MuJoCo's since 3.12.

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

from diffsim.kernels.pairs.spheres import TINY, sphere_contacts
from diffsim.kernels.pairs.touch import geom_types
from diffsim.kernels.thread.model import functions
from diffsim.robot.types import BOXES, CONTACTS

# In float64 and in float32, as MuJoCo's
AXIS_SQ = 1e-16, 1e-7  # square of the least sine between two edges whose cross product is an axis
SLACK = 1e-13, 1e-6  # of the test for separation, in sums of the half lengths
SAME_SQ = 1e-14, 1e-10  # square of the distance between two corners, in half diagonals of the face
SKEW = 1e-6, 1e-3  # least sine between an edge and a side along which their corner slides, for the adjoint
ROUNDING = 1e-9, 1e-6  # of a corner in a face, in half lengths
EDGE_BIAS = 1e-6  # relative, by which the axis of two edges must be better than the one before
ALIAS, ALIAS_BIAS = 0.99, 0.05  # the cosine beyond which such an axis must be better than a face's by so much
CORNERS = CONTACTS[BOXES]
APART, EDGES = -1, 6  # no axis, and the first of the axes of edges; those of faces are 0 to 5


@cache
def face_clipping(U: type) -> SimpleNamespace:
    """Make the functions that clip one face to another for numbers of this type."""
    t, single = geom_types(U), int(U == wp.float32)
    vec2, vec3, vec4, Touches = t.vec2, t.vec3, t.vec4, t.Touches
    same_sq, skew, rounding = (each[single] for each in (SAME_SQ, SKEW, ROUNDING))

    @wp.func
    def append(count: int, z: vec3, a: vec3, b: vec3, kept: U, same: U, found: Touches):
        """Append a corner unless one that is listed has its place; returns their number."""
        for k in range(count):
            gap = found[k].z - z
            if gap[0] * gap[0] + gap[1] * gap[1] < same:
                return count
        if count == CORNERS:
            return count
        found[count].z = z
        found[count].a = a
        found[count].b = b
        found[count].how = vec4(U(0.0), U(0.0), kept, U(0.0))
        return count + 1

    @wp.func
    def corner(centre: vec3, du: vec3, dv: vec3, k: int):
        """Return corner k of a parallelogram with the half edges du, dv, one after the other around it."""
        return centre + U(1.0 - 2.0 * float((k + 1) // 2 % 2)) * du + U(1.0 - 2.0 * float(k // 2 % 2)) * dv

    @wp.func
    def clip(centre: vec3, du: vec3, dv: vec3, half: vec2, found: Touches):
        """Clip the parallelogram of half edges du, dv to the rectangle |x|, |y| <= half; returns how many corners."""
        same = U(same_sq) * wp.dot(half, half)
        count = int(0)
        for k in range(4):
            # this edge from p to q, and the sides where it was cut
            p = corner(centre, du, dv, k)
            q = corner(centre, du, dv, k + 1)
            D = q - p
            m_p = vec3()
            m_q = vec3()
            outside = int(0)
            for side in range(4):
                i = side // 2
                e = U(1.0 - 2.0 * float(side % 2))
                p_out = e * p[i] - half[i]
                q_out = e * q[i] - half[i]
                m = vec3()
                if wp.abs(D[i]) > U(skew) * wp.length(D):
                    m[i] = U(-1.0) / D[i]
                if p_out > U(0.0) and q_out > U(0.0):
                    outside = 1
                elif p_out > U(0.0):
                    p = p + (p_out / (p_out - q_out)) * (q - p)
                    m_p = m
                elif q_out > U(0.0):
                    q = p + (p_out / (p_out - q_out)) * (q - p)
                    m_q = m
            if outside == 0:
                count = append(count, p, m_p, D, U(1.0), same, found)
                count = append(count, q, m_q, D, U(1.0), same, found)
        w = wp.cross(du, dv)
        w = w / w[2]
        up = vec3(U(0.0), U(0.0), U(1.0))
        inv_u = wp.cross(dv, up) / wp.dot(wp.cross(dv, up), du)
        inv_v = wp.cross(du, up) / wp.dot(wp.cross(du, up), dv)
        for k in range(4):
            r = corner(vec3(), vec3(half[0], U(0.0), U(0.0)), vec3(U(0.0), half[1], U(0.0)), k) - centre
            alpha = wp.dot(inv_u, r)
            beta = wp.dot(inv_v, r)
            # of equal faces on each other, edges may be outside by rounding: then these corners are left
            if wp.max(wp.abs(alpha), wp.abs(beta)) < U(1.0) + U(rounding):
                count = append(count, centre + alpha * du + beta * dv, w, up, U(0.0), same, found)
        return count

    return functions(locals())


@cache
def box_contacts(U: type) -> SimpleNamespace:
    """Make the functions for numbers of this type."""
    t, spheres = geom_types(U), sphere_contacts(U)
    vec2, vec3, vec4, mat3, Geom, Touch, Touches = t.vec2, t.vec3, t.vec4, t.mat3, t.Geom, t.Touch, t.Touches
    column, nearest, clip = spheres.column, spheres.nearest, face_clipping(U).clip
    axis_sq, slack = (each[int(U == wp.float32)] for each in (AXIS_SQ, SLACK))

    @wp.func
    def extent(size: vec3, n: vec3):
        """Return how far a box reaches from its centre along n, an axis in its frame."""
        return wp.dot(size, wp.abs(n))

    @wp.func
    def separating_axis(one: Geom, other: Geom, margin: U):
        """Find the axis along which two boxes overlap least.

        Returns:
            its number: i or 3 + i of a face normal to axis i of the first box or of the second, 6 + 3 i + j of edges
            along axis i of the first and j of the second, APART if the boxes are farther from each other than the
            margin; and the axis of edges in the world, towards the second box.
        """
        Q = wp.transpose(one.R) * other.R
        d = wp.transpose(one.R) * (other.x - one.x)
        d2 = wp.transpose(other.R) * (other.x - one.x)
        ones = vec3(U(1.0), U(1.0), U(1.0))
        reach = margin + U(slack) * (wp.dot(one.size, ones) + wp.dot(other.size, ones))
        number = int(APART)
        best = U(-1e30)
        for k in range(6):
            i = k % 3
            gap = wp.abs(d[i]) - one.size[i] - extent(other.size, Q[i])
            if k > 2:
                gap = wp.abs(d2[i]) - other.size[i] - extent(one.size, column(Q, i))
            if gap > reach:
                return APART, d
            if gap > best:
                best = gap
                number = k
        face = best
        face_number = number
        axis = vec3()
        edges, bias = int(EDGES), U(EDGE_BIAS)  # here, as Warp reads a named constant only where it first appears
        for k in range(9):
            e = vec3()
            e[k // 3] = U(1.0)
            n = wp.cross(e, column(Q, k % 3))
            square = wp.dot(n, n)
            if square > U(axis_sq):
                n = n / wp.sqrt(square)
                gap = wp.abs(wp.dot(n, d)) - extent(one.size, n) - extent(other.size, wp.transpose(Q) * n)
                if gap > reach:
                    return APART, d
                if gap > face and gap - bias * wp.abs(gap) > best:
                    best = gap
                    number = edges + k
                    axis = n
        normal = vec3()
        if face_number < 3:
            normal[face_number] = U(1.0)
        else:
            normal = column(Q, face_number - 3)
        if wp.abs(wp.dot(axis, normal)) > U(ALIAS) and best < face + U(ALIAS_BIAS) * wp.abs(face) + U(TINY):
            number = face_number
        return number, wp.sign(wp.dot(axis, d)) * (one.R * axis)

    @wp.func
    def face_contacts(ref: Geom, inc: Geom, axis: int, side: U, found: Touches):
        """Find the corners of the box inc on the face of the box ref with this axis; returns their number.

        The normal is the face's own, outward, or minus that: side is 1 if ref is the first box, else -1.
        """
        x = (axis + 1) % 3
        y = (axis + 2) % 3
        N = column(ref.R, axis)
        N = wp.sign(wp.dot(N, inc.x - ref.x)) * N
        back = wp.matrix_from_cols(column(ref.R, x), column(ref.R, y), N)
        # the face of the other box that opposes this one most
        R = wp.transpose(back) * inc.R
        facing = R[2]
        g = int(wp.argmax(wp.abs(facing)))
        u = (g + 1) % 3
        v = (g + 2) % 3
        centre = wp.transpose(back) * (inc.x - ref.x) - wp.sign(facing[g]) * inc.size[g] * column(R, g)
        centre[2] = centre[2] - ref.size[axis]
        du = inc.size[u] * column(R, u)
        dv = inc.size[v] * column(R, v)
        count = clip(centre, du, dv, vec2(ref.size[x], ref.size[y]), found)
        for k in range(count):
            dist = found[k].z[2]
            found[k].dist = dist
            found[k].z = ref.x + ref.size[axis] * N + back * found[k].z
            found[k].p = found[k].z - U(0.5) * dist * N
            found[k].n = side * N
            found[k].a = back * found[k].a
            found[k].b = back * found[k].b
            found[k].how[1] = wp.max(side, U(0.0))
        return count

    @wp.func
    def corner_of(R: mat3, h: vec3, n: vec3, axis: int):
        """Return the middle of the edge along that axis which is farthest in the direction n, from a box's centre."""
        corner = wp.transpose(R) * n
        for k in range(3):
            corner[k] = wp.sign(corner[k]) * h[k]
        corner[axis] = U(0.0)
        return R * corner

    @wp.func
    def edge_contact(one: Geom, other: Geom, i: int, j: int, n: vec3):
        """Return the contact of the edges along axis i of one box and j of the other, with the common normal n."""
        touch = Touch()
        touch.a = one.size[i] * column(one.R, i)
        touch.b = other.size[j] * column(other.R, j)
        x1 = one.x + corner_of(one.R, one.size, n, i)
        s1, s2, d = nearest(x1, touch.a, other.x + corner_of(other.R, other.size, -n, j), touch.b)
        touch.z = x1 + s1 * touch.a
        touch.p = touch.z + U(0.5) * d
        touch.n = n
        touch.dist = wp.dot(n, d)
        touch.how = vec4(U(1.0), U(0.0), spheres.is_free(s1, touch.a), spheres.is_free(s2, touch.b))
        return touch

    @wp.func
    def box_box(one: Geom, other: Geom, margin: U, found: Touches):
        """Find the contacts of two boxes that are not farther from each other than the margin; returns their number.

        `how` has 1 for two edges; 1 for a face of the first box; `kept` of a corner, or 1 where the first edge's point
        is free to move; 1 where the second one's is.
        """
        number, n = separating_axis(one, other, margin)
        if number == APART:
            return 0
        if number >= EDGES:
            found[0] = edge_contact(one, other, (number - EDGES) // 3, (number - EDGES) % 3, n)
            return 1
        if number < 3:
            return face_contacts(one, other, number, U(1.0), found)
        return face_contacts(other, one, number - 3, U(-1.0), found)

    return functions(locals())

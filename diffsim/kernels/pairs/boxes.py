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
APART, EDGES = -1, 6  # no axis, and the first of the axes of edges; those of faces are 0 to 5


@cache
def box_contacts(U: type) -> SimpleNamespace:
    """Make the functions for numbers of this type."""
    t, spheres = geom_types(U), sphere_contacts(U)
    vec2, vec3, vec4, mat3, Geom, Touch, Touches = t.vec2, t.vec3, t.vec4, t.mat3, t.Geom, t.Touch, t.Touches
    sign, column, nearest = spheres.sign, spheres.column, spheres.nearest
    single = int(U == wp.float32)
    axis_sq, slack, same_sq, skew, rounding = (each[single] for each in (AXIS_SQ, SLACK, SAME_SQ, SKEW, ROUNDING))

    @wp.func
    def separating_axis(one: Geom, other: Geom, margin: U):
        """Find the axis along which two boxes overlap least.

        Returns:
            its number: i or 3 + i of a face normal to axis i of the first box or of the second, 6 + 3 i + j of edges
            along axis i of the first and j of the second, APART if the boxes are farther from each other than the
            margin; and that axis, in the world.
        """
        Q = wp.transpose(one.R) * other.R
        d = wp.transpose(one.R) * (other.x - one.x)
        reach = margin + U(slack) * (
            one.size[0] + one.size[1] + one.size[2] + other.size[0] + other.size[1] + other.size[2]
        )
        number = int(APART)
        normal = vec3()
        best = U(-1e30)
        for k in range(6):
            n = vec3()
            if k < 3:
                n[k] = U(1.0)
            else:
                n = column(Q, k - 3)
            gap = wp.abs(wp.dot(n, d)) - wp.dot(one.size, wp.abs(n)) - wp.dot(other.size, wp.abs(wp.transpose(Q) * n))
            if gap > reach:
                return APART, normal
            if gap > best:
                best = gap
                number = k
                normal = n
        face = best
        face_number = number
        face_normal = normal
        for k in range(9):
            e = vec3()
            e[k // 3] = U(1.0)
            n = wp.cross(e, column(Q, k % 3))
            square = wp.dot(n, n)
            if square > U(axis_sq):
                n = n / wp.sqrt(square)
                gap = (
                    wp.abs(wp.dot(n, d)) - wp.dot(one.size, wp.abs(n)) - wp.dot(other.size, wp.abs(wp.transpose(Q) * n))
                )
                if gap > reach:
                    return APART, normal
                if gap > face and gap - U(EDGE_BIAS) * wp.abs(gap) > best:
                    best = gap
                    number = EDGES + k
                    normal = n
        if wp.abs(wp.dot(normal, face_normal)) > U(ALIAS):
            if best < face + U(ALIAS_BIAS) * wp.abs(face) + U(TINY):
                number = face_number
                normal = face_normal
        return number, sign(wp.dot(normal, d)) * (one.R * normal)

    @wp.func
    def append(count: int, corner: Touch, same: U, found: Touches):
        """Append a corner unless one that is listed has its place; returns their number."""
        for k in range(count):
            gap = found[k].z - corner.z
            if gap[0] * gap[0] + gap[1] * gap[1] < same:
                return count
        if count == CORNERS:
            return count
        found[count] = corner
        return count + 1

    @wp.func
    def clip(centre: vec3, du: vec3, dv: vec3, half: vec2, found: Touches):
        """Clip the parallelogram of half edges du, dv to the rectangle |x|, |y| < half; returns how many corners."""
        same = U(same_sq) * wp.dot(half, half)
        count = int(0)
        D = U(-2.0) * du
        next_D = U(-2.0) * dv
        p = centre + du + dv
        for _ in range(4):
            # the part of this edge that is inside, from t0 to t1, and the sides at its ends
            t0 = U(0.0)
            t1 = U(1.0)
            start = Touch()
            end = Touch()
            for i in range(2):
                inv = sign(D[i]) / wp.max(wp.abs(D[i]), U(1e-20))
                enter = inv * (-sign(D[i]) * half[i] - p[i])
                leave = inv * (sign(D[i]) * half[i] - p[i])
                side = vec3()
                if wp.abs(D[i]) > U(skew) * wp.length(D):
                    side[i] = -inv
                if enter > t0:
                    t0 = enter
                    start.a = side
                if leave < t1:
                    t1 = leave
                    end.a = side
            if t0 < t1:
                start.z = p + t0 * D
                start.b = D
                start.how[2] = U(1.0)
                count = append(count, start, same, found)
                if t1 < U(1.0):
                    end.z = p + t1 * D
                    end.b = D
                    end.how[2] = U(1.0)
                    count = append(count, end, same, found)
            p = p + D
            turned = next_D
            next_D = -D
            D = turned
        w = wp.cross(du, dv)
        inv_area = U(1.0) / w[2]
        for k in range(4):
            r = vec3(half[0] * U(1.0 - 2.0 * float(k % 2)), half[1] * U(1.0 - 2.0 * float(k // 2)), U(0.0)) - centre
            alpha = (r[0] * dv[1] - r[1] * dv[0]) * inv_area
            beta = (du[0] * r[1] - du[1] * r[0]) * inv_area
            # of equal faces on each other, edges may be outside by rounding: then these corners are left
            if wp.max(wp.abs(alpha), wp.abs(beta)) < U(1.0) + U(rounding):
                corner = Touch()
                corner.z = centre + alpha * du + beta * dv
                corner.a = inv_area * w
                corner.b = vec3(U(0.0), U(0.0), U(1.0))
                count = append(count, corner, same, found)
        return count

    @wp.func
    def face_contacts(ref: Geom, inc: Geom, axis: int, N: vec3, found: Touches):
        """Find the corners of the box inc on the face of the box ref with this axis and the normal N, which is outward.

        Returns their number; their normal is N.
        """
        x = (axis + 1) % 3
        y = (axis + 2) % 3
        X = column(ref.R, x)
        Y = column(ref.R, y)
        frame = wp.matrix_from_rows(X, Y, N)
        # the face of the other box that opposes this one most
        facing = wp.transpose(inc.R) * N
        g = int(0)
        for k in range(1, 3):
            if wp.abs(facing[k]) > wp.abs(facing[g]):
                g = k
        u = (g + 1) % 3
        v = (g + 2) % 3
        centre = frame * (inc.x - ref.x - sign(facing[g]) * inc.size[g] * column(inc.R, g))
        centre[2] = centre[2] - ref.size[axis]
        du = inc.size[u] * (frame * column(inc.R, u))
        dv = inc.size[v] * (frame * column(inc.R, v))
        count = clip(centre, du, dv, vec2(ref.size[x], ref.size[y]), found)
        back = wp.transpose(frame)
        for k in range(count):
            dist = found[k].z[2]
            found[k].dist = dist
            found[k].z = ref.x + ref.size[axis] * N + back * found[k].z
            found[k].p = found[k].z - U(0.5) * dist * N
            found[k].n = N
            found[k].a = back * found[k].a
            found[k].b = back * found[k].b
        return count

    @wp.func
    def corner_of(R: mat3, h: vec3, n: vec3, axis: int):
        """Return the middle of the edge along that axis which is farthest in the direction n, from a box's centre."""
        corner = wp.transpose(R) * n
        for k in range(3):
            corner[k] = sign(corner[k]) * h[k]
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
            count = face_contacts(one, other, number, n, found)
            for k in range(count):
                found[k].how[1] = U(1.0)
            return count
        count = face_contacts(other, one, number - 3, -n, found)
        for k in range(count):
            found[k].n = n
        return count

    return functions(locals())

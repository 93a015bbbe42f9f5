"""Contacts of spheres and capsules with each other, and of a sphere with a box, of one environment.

The axis of a capsule is a segment x + s a, |s| <= 1, with a = 0 of a sphere. Two segments touch at their nearest
points. Capsules that are all but parallel touch at both ends of the stretch along which they lie beside each other. A
sphere whose centre is in a box touches the face that is nearest to it.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.touch import geom_types
from diffsim.kernels.thread.model import functions

TINY = 1e-15  # MuJoCo's, of a distance and of a determinant
# In float64, as MuJoCo's, and in float32
PARALLEL_SQ = 1e-8, 1e-6  # square of the sine between two parallel capsules
SURFACE = 1e-12, 1e-6  # m, of a sphere's centre from a box


@cache
def sphere_contacts(U: type) -> SimpleNamespace:
    """Make the functions for numbers of this type."""
    t = geom_types(U)
    vec3, vec4, mat3, Geom, Touch, Touches = t.vec3, t.vec4, t.mat3, t.Geom, t.Touch, t.Touches
    parallel_sq, surface = (each[int(U == wp.float32)] for each in (PARALLEL_SQ, SURFACE))

    @wp.func
    def column(R: mat3, i: int):
        """Return an axis of a frame."""
        return vec3(R[0, i], R[1, i], R[2, i])

    @wp.func
    def half_axis(geom: Geom):
        """Return half the axis of a capsule, 0 of a sphere."""
        return geom.size[1] * column(geom.R, 2)

    @wp.func
    def clamped(x: U):
        return wp.clamp(x, U(-1.0), U(1.0))

    @wp.func
    def nearest(x1: vec3, a1: vec3, x2: vec3, a2: vec3):
        """Return s_1 and s_2 of the nearest points of two segments, and the vector from the first one to the second."""
        ma = wp.dot(a1, a1)
        mb = wp.dot(a1, a2)
        mc = wp.dot(a2, a2)
        u = wp.dot(a1, x2 - x1)
        v = wp.dot(a2, x1 - x2)
        det = wp.max(ma * mc - mb * mb, U(TINY))  # here, as Warp reads a named constant only where it first appears
        s1 = U(0.0)
        if ma > U(0.0):
            s1 = clamped((mc * u + mb * v) / det)
        free = (v + mb * s1) / wp.max(mc, U(TINY))
        s2 = clamped(free)
        if s2 != free:
            s1 = clamped((u + mb * s2) / wp.max(ma, U(TINY)))
        return s1, s2, (x2 + s2 * a2) - (x1 + s1 * a1)

    @wp.func
    def is_free(s: U, a: vec3):
        """Return 1 if the point s may move along its axis a, else 0: at an end, or of a sphere."""
        if wp.abs(s) < U(1.0) and wp.dot(a, a) > U(0.0):
            return U(1.0)
        return U(0.0)

    @wp.func
    def touch_at(one: Geom, other: Geom, s1: U, s2: U):
        """Return the contact of the spheres at s_1 and s_2 of two axes."""
        a1 = half_axis(one)
        a2 = half_axis(other)
        z = one.x + s1 * a1
        d = other.x + s2 * a2 - z
        length = wp.length(d)
        touch = Touch()
        touch.n = vec3(U(1.0), U(0.0), U(0.0))
        if length > U(TINY):
            touch.n = d / length
        touch.p = z + U(0.5) * (d + (one.size[0] - other.size[0]) * touch.n)
        touch.dist = length - one.size[0] - other.size[0]
        touch.how = vec4(is_free(s1, a1), is_free(s2, a2), U(0.0), U(0.0))
        return touch

    @wp.func
    def segment_segment(one: Geom, other: Geom):
        """Return the contact of two spheres or capsules at their nearest points."""
        s1, s2, d = nearest(one.x, half_axis(one), other.x, half_axis(other))
        return touch_at(one, other, s1, s2)

    @wp.func
    def capsule_capsule(one: Geom, other: Geom, found: Touches):
        """Find the two contacts of parallel capsules, or the one of others; returns their number."""
        a1 = half_axis(one)
        a2 = half_axis(other)
        ma = wp.dot(a1, a1)
        mb = wp.dot(a1, a2)
        mc = wp.dot(a2, a2)
        if ma * mc - mb * mb >= U(parallel_sq) * ma * mc:
            found[0] = segment_segment(one, other)
            return 1
        d = other.x - one.x
        for k in range(2):
            end = U(2.0 * float(k) - 1.0)  # of the first capsule, or that of the second one which lies before it
            facing = end * wp.sign(mb)
            s1 = (wp.dot(a1, d) + facing * mb) / ma
            s2 = facing
            if end * s1 >= U(1.0):
                s1 = end
                s2 = clamped((end * mb - wp.dot(a2, d)) / mc)
            found[k] = touch_at(one, other, clamped(s1), s2)
        return 2

    @wp.func
    def sphere_box(centre: vec3, r: U, box: Geom):
        """Return the contact of a sphere and a box.

        `how` has 1 for each axis of the box along which its point follows the sphere, else 0, and 1 at a face.
        """
        y = wp.transpose(box.R) * (centre - box.x)
        d = vec3()
        free = vec3(U(1.0), U(1.0), U(1.0))
        for i in range(3):
            if wp.abs(y[i]) > box.size[i]:
                d[i] = wp.sign(y[i]) * box.size[i] - y[i]
                free[i] = U(0.0)
        length = wp.length(d)
        touch = Touch()
        if length > U(surface):
            touch.n = box.R * (d / length)
            touch.dist = length - r
        else:
            axis = int(0)
            side = U(1.0)
            depth = U(2.0) * (box.size[0] + box.size[1] + box.size[2])
            for i in range(3):
                if wp.abs(box.size[i] + y[i]) < depth:
                    depth = wp.abs(box.size[i] + y[i])
                    axis = i
                    side = U(1.0)
                if wp.abs(box.size[i] - y[i]) < depth:
                    depth = wp.abs(box.size[i] - y[i])
                    axis = i
                    side = U(-1.0)
            touch.n = side * column(box.R, axis)
            touch.dist = -depth - r
            free = vec3(U(1.0), U(1.0), U(1.0))
            free[axis] = U(0.0)
        touch.p = centre + (r + U(0.5) * touch.dist) * touch.n
        face = U(0.0)
        if free[0] + free[1] + free[2] > U(1.5):
            face = U(1.0)
        touch.how = vec4(free[0], free[1], free[2], face)
        return touch

    return functions(locals())

"""The adjoint of contacts of two geoms (geoms.py): of a point, a distance and a normal by the pose of the second link.

The derivative of the distance of two nearest points is that at fixed s, where it is least or at a bound (envelope
theorem). That of the points adds m a, how s moves with them. `how`, z, a and b of a contact say what it is of.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.geoms import pair_geoms
from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.pairs.spheres import TINY
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.types import BALL_BOX, BOXES, CAPSULE_BOX

# Least square of the sine between two segments for the adjoint of their nearest points, in float64 and in float32
PARALLEL = 1e-12, 1e-6


@cache
def touch_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of the adjoint.

    Each returns the adjoint of the second link's pose beside a first one that stays, as a wrench about the origin of
    J.reference. The adjoints of the contact's point are g_p, of its distance g_r, of its normal n g_n. It moves rigidly
    with both links together, so that the first one's wrench follows (adjoint.py).
    """
    t, sp, block, geoms, J = types(spec), spatial(spec), blocks(spec), pair_geoms(spec, True), pair_jacobian(spec)
    T, vec3, vec6, mat3, Model, Links, Contacts = t.T, t.vec3, t.vec6, t.mat3, t.Model, t.Links, t.Contacts
    pick, force_at, join, frame_of = block.pick, sp.force_at, sp.join, geoms.frame_of
    LEAST_DET = PARALLEL[int(t.U == wp.float32)]
    BALLS, CAPSULE_BOXES, TWO_BOXES = spec.has("ball_box_geoms capsule_box_geoms box_geoms")

    @wp.func
    def blend(which: T, a: vec6, b: vec6):
        """Return a where which is 1, b where it is 0, whatever the other one is."""
        result = b
        for k in range(6):
            result[k] = pick(T(0.5), which, a[k], b[k])
        return result

    @wp.func
    def normal_adjoint(n: vec3, E: mat3, g_turn: vec3):
        """Return the adjoint of a contact's normal by that of a rotation of its frame E, in the frame."""
        frame, along, size = geoms.contact_frame(n)
        return E * vec3(g_turn[1], -g_turn[0] - along / size * g_turn[2], T(0.0))

    @wp.func
    def half_axis(m: Model, end: int, links: Links):
        """Return half the axis of a capsule, 0 of a sphere."""
        R = frame_of(m, end, links)
        return T(m.row_size[end][1]) * vec3(R[0, 2], R[1, 2], R[2, 2])

    @wp.func
    def slide_adjoint(z1: vec3, d: vec3, a1: vec3, a2: vec3, free1: T, free2: T, g1: vec3, g2: vec3):
        """Return the wrench of the adjoints of two nearest points, z_1 and z_1 + d.

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
        return force_at(z1 + d, g2 + m1 * a1 + m2 * a2) + join(m2 * wp.cross(a2, d), vec3())

    @wp.func
    def boxes_adjoint(m: Model, c: int, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of a contact of two boxes."""
        how = contacts[c].how
        z = contacts[c].z
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
        wrench = blend(how[1], inc, ref)
        if block.any_of(how[0]):
            d = T(2.0) * (contacts[c].p - z)
            g_n = g_n + g_r * (d - wp.dot(d, n) * n)
            g1, g2 = T(0.5) * g_p - g_r * n, T(0.5) * g_p + g_r * n
            two = slide_adjoint(z, d, a, b, how[2], how[3], g1, g2)
            across = wp.cross(a, b)
            scale = pick(wp.dot(across, n), T(0.0), T(-1.0), T(1.0)) / wp.max(wp.length(across), T(TINY))
            g_across = scale * (g_n - wp.dot(g_n, n) * n)
            two = two + join(wp.cross(b, wp.cross(g_across, a)), vec3())
            wrench = blend(how[0], two, wrench)
        return wrench

    @wp.func
    def contact_adjoint(m: Model, c: int, links: Links, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of a contact."""
        s = contacts[c].row
        kind = m.row_touch[s]
        if wp.static(TWO_BOXES):
            if kind == BOXES:
                return boxes_adjoint(m, c, contacts, n, g_p, g_r, g_n)
        how = contacts[c].how
        r1 = T(m.row_size[2 * s][0])
        r2 = T(m.row_size[2 * s + 1][0])
        if wp.static(BALLS or CAPSULE_BOXES):
            if kind >= BALL_BOX:
                r2 = T(0.0)
        length = contacts[c].r + T(m.row_params[s][10]) + r1 + r2  # of n from the axis or centre z1 to the other one
        z1 = contacts[c].p - T(0.5) * (length + r1 - r2) * n
        g_d = g_n + T(0.5) * (r1 - r2) * (g_p - wp.dot(g_p, n) * n)
        g_d = pick(T(TINY), wp.abs(length), T(1.0) / length, T(0.0)) * g_d + g_r * n
        g2 = T(0.5) * g_p + g_d
        if wp.static(BALLS or CAPSULE_BOXES):
            if kind >= BALL_BOX:
                # the box's point follows the sphere along its free axes
                R = frame_of(m, 2 * s + 1, links)
                free = vec3(how[0], how[1], how[2])
                wrench = force_at(z1 + length * n, g2) - force_at(z1, R * wp.cw_mul(free, wp.transpose(R) * g2))
                # at a face the normal is the box's, whatever the distance
                turn = wp.cross(n, g_n + T(0.5) * (length + r1) * g_p)
                face = force_at(z1, (g_r + T(0.5) * wp.dot(n, g_p)) * n) + join(turn, vec3())
                wrench = blend(how[3], face, wrench)
                if wp.static(CAPSULE_BOXES):
                    if kind == CAPSULE_BOX:  # as s moves
                        centre = J.point_about(m, 2 * s, J.reference(m, s), links)
                        a1 = half_axis(m, 2 * s, links)
                        g_s = wp.dot(g_p - wp.spatial_bottom(wrench), a1)
                        wrench = wrench - force_at(centre, g_s * contacts[c].a)
                        wrench = wrench - join(g_s * wp.cross(a1, contacts[c].b), vec3())
                return wrench
        a1 = half_axis(m, 2 * s, links)
        a2 = half_axis(m, 2 * s + 1, links)
        return slide_adjoint(z1, length * n, a1, a2, how[0], how[1], T(0.5) * g_p - g_d, g2)

    return functions(locals())

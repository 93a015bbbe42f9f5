"""MuJoCo's friction cones: the force of a contact as a function of jar (impedance.py), its normal along z.

elliptic     the quadratic zone, where the ground holds the point, the cone's zone, where it slides, and no force
pyramidal    four edges n +- friction t, each a one-sided row of its own: force -D_e jar . e where jar . e < 0, with

    D_e = D impratio / (2 friction^2 (1 + friction^2))

The tangents t are those of the ground's frame E. Of a capsule one of them points along it, so that the frame turns with
its heading: MuJoCo aligns the frames of a plane's contacts with capsules so.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.terrain import terrain_contact
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks

LEAST_FRICTION = 1e-5  # MuJoCo's, of a contact with friction
UPRIGHT = 1e-9  # horizontal part of a capsule's unit vector, below which its contacts have the ground's frame


def friction_cone(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of the file's cone."""
    return pyramidal_cone(spec) if "pyramid" in spec.features else elliptic_cone(spec)


@cache
def elliptic_cone(spec: KernelSpec) -> SimpleNamespace:
    """Make the force of a contact in an elliptic cone."""
    t, pick = types(spec), blocks(spec).pick
    T, vec3, mat3 = t.T, t.vec3, t.mat3

    @wp.func
    def force(D: T, friction: T, inv_impratio: T, jar: vec3, sticking: T):
        """Return a contact's force, and H, minus its derivatives in jar.

        Where sticking is 1, the zone is MuJoCo's quadratic one, whatever jar is.
        """
        normal = jar[2]
        slip = wp.sqrt(jar[0] * jar[0] + jar[1] * jar[1])
        quadratic = wp.max(sticking, pick(slip, -friction * inv_impratio * normal, T(1.0), T(0.0)))
        conical = wp.max(pick(normal, friction * slip, T(1.0), T(0.0)) - quadratic, T(0.0))
        Dn = quadratic * D
        Dt = Dn / inv_impratio
        Ds = conical * D / (T(1.0) + friction * friction * inv_impratio)
        over = normal - friction * slip
        inv_slip = pick(T(0.0), slip, T(1.0) / slip, T(0.0))
        tx = inv_slip * jar[0]
        ty = inv_slip * jar[1]
        across = Dt - Ds * over * friction * inv_slip
        along = Ds * friction * friction - (across - Dt)
        nx = -Ds * friction * tx
        ny = -Ds * friction * ty
        xy = along * tx * ty
        f = vec3(-across * jar[0], -across * jar[1], -Dn * normal - Ds * over)
        H = mat3(across + along * tx * tx, xy, nx, xy, across + along * ty * ty, ny, nx, ny, Dn + Ds)
        return f, H

    @wp.func
    def friction_derivative(D: T, friction: T, inv_impratio: T, jar: vec3, w: vec3):
        """Return w . df / d friction, which is 0 outside the cone's zone."""
        slip = wp.sqrt(jar[0] * jar[0] + jar[1] * jar[1])
        quadratic = pick(slip, -friction * inv_impratio * jar[2], T(1.0), T(0.0))
        conical = pick(jar[2], friction * slip, T(1.0), T(0.0)) - quadratic
        inv_slip = pick(T(0.0), slip, T(1.0) / slip, T(0.0))
        mu2 = T(1.0) + friction * friction * inv_impratio
        Ds = conical * D / mu2
        over = jar[2] - friction * slip
        change = Ds * (T(2.0) * friction * inv_impratio / mu2 * over + slip)  # of the normal force
        along = inv_slip * (jar[0] * w[0] + jar[1] * w[1])
        return change * w[2] + (Ds * over - friction * change) * along

    return functions(locals())


@cache
def pyramidal_cone(spec: KernelSpec) -> SimpleNamespace:
    """Make the same of a pyramidal cone, and its heading."""
    t, pick, in_frame = types(spec), blocks(spec).pick, terrain_contact(spec).in_frame
    T, U, vec3, vec4, mat3 = t.T, t.U, t.vec3, t.vec4, t.mat3

    @wp.func
    def force(D: T, friction: T, inv_impratio: T, jar: vec3, sticking: T):
        """Return a contact's force, and H, minus its derivatives in jar; where sticking is 1, all edges have theirs.

        Without friction the edges are one row, the normal's, four times.
        """
        mu_sq = wp.max(friction, T(LEAST_FRICTION)) * wp.max(friction, T(LEAST_FRICTION))
        edge = T(0.5) * D / (mu_sq * inv_impratio * (T(1.0) + mu_sq))
        edge = pick(T(0.0), friction, edge, T(0.25) * D)
        s = vec4()  # 1 for edges along x, -x, y and -y that push
        for k in range(4):
            slip = friction * jar[k / 2] * T(1 - 2 * (k % 2))
            s[k] = wp.max(sticking, pick(jar[2] + slip, T(0.0), T(1.0), T(0.0)))
        x = friction * (s[0] - s[1])
        y = friction * (s[2] - s[3])
        xx = friction * friction * (s[0] + s[1])
        yy = friction * friction * (s[2] + s[3])
        H = edge * mat3(xx, T(0.0), x, T(0.0), yy, y, x, y, s[0] + s[1] + s[2] + s[3])
        return -(H * jar), H

    @wp.func
    def friction_derivative(D: T, friction: T, inv_impratio: T, jar: vec3, w: vec3):
        """Return w . df / d friction."""
        f, H = force(D, friction, inv_impratio, jar, T(0.0))
        mu_sq = friction * friction
        stiffness = -(T(2.0) + T(4.0) * mu_sq) / (T(1.0) + mu_sq) * wp.dot(f, w)  # by D_e
        across = H[0, 0] * jar[0] * w[0] + H[1, 1] * jar[1] * w[1]
        mixed = H[0, 2] * (jar[0] * w[2] + jar[2] * w[0]) + H[1, 2] * (jar[1] * w[2] + jar[2] * w[1])
        return pick(T(0.0), friction, (stiffness - T(2.0) * across - mixed) / friction, T(0.0))

    @wp.func
    def heading(m: t.Model, c: int, R: mat3, E: t.Frame):
        """Return cosine and sine of a capsule's heading on link R, its slope downwards, and 1; else (1, 0, 0, 0)."""
        axis = in_frame(E, R * vec3(m.contact_axis[c]))
        level = wp.sqrt(axis[0] * axis[0] + axis[1] * axis[1])
        result = vec4(T(1.0), T(0.0), T(0.0), T(0.0))
        if m.contact_radius[c] > U(0.0):
            found = vec4(axis[0] / level, axis[1] / level, -axis[2] / level, T(1.0))
            for k in range(4):
                result[k] = pick(T(UPRIGHT), level, found[k], result[k])
        return result

    @wp.func
    def frame(h: vec4):
        """Return the frame of that heading in E."""
        return mat3(h[0], -h[1], T(0.0), h[1], h[0], T(0.0), T(0.0), T(0.0), T(1.0))

    @wp.func
    def heading_derivative(h: vec4):
        """Return the heading's derivative by a rotation of the link, in E."""
        return vec3(h[2] * h[0], h[2] * h[1], h[3])

    return functions(locals())

"""Spatial algebra (Featherstone 2008) beyond Warp's builtins: (angular, linear) in world axes.

Warp has the rest: spatial_top/bottom, spatial_cross (motion x motion), spatial_cross_dual (motion x* force), skew.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def spatial(spec: KernelSpec) -> SimpleNamespace:
    """Make the operations on spatial vectors, quaternions and rotation vectors."""
    t, pick = types(spec), blocks(spec).pick
    T, vec3, vec6, mat3, quat, uvec3 = t.T, t.vec3, t.vec6, t.mat3, t.quat, t.scene.vec3

    @wp.func
    def join(a: vec3, b: vec3):
        return vec6(a[0], a[1], a[2], b[0], b[1], b[2])

    @wp.func
    def force_at(p: vec3, f: vec3):
        """Return the wrench of a force f through the point p; also the adjoint of point_velocity."""
        return join(wp.cross(p, f), f)

    @wp.func
    def point_velocity(v: vec6, p: vec3):
        return wp.spatial_bottom(v) + wp.cross(wp.spatial_top(v), p)

    @wp.func
    def on_link(R: mat3, x: vec3, p: uvec3):
        """Return the position of a link's point p."""
        return x + R * vec3(p)

    @wp.func
    def momentum(mass: T, com: vec3, inertia: mat3, v: vec6):
        """Multiply a rigid-body inertia (about its centre of mass) by a motion vector."""
        p = mass * point_velocity(v, com)
        return join(inertia * wp.spatial_top(v) + wp.cross(com, p), p)

    @wp.func
    def exp_quat(r: vec3):
        """Return the quaternion of the rotation vector r, exact and smooth at 0."""
        angle = wp.length(r)
        s = pick(T(1e-3), angle, wp.sin(T(0.5) * angle) / angle, T(0.5) - angle * angle / T(48.0))
        return quat(s * r[0], s * r[1], s * r[2], wp.cos(T(0.5) * angle))

    @wp.func
    def exp_adjoint(r: vec3, g: vec3):
        """Return the adjoints of r and q in q' = q exp(r), all in the body's tangent space: J_r(r)' g and Exp(r) g."""
        angle = wp.length(r)
        small = T(2e-2)
        k1 = pick(small, angle, (T(1.0) - wp.cos(angle)) / (angle * angle), T(0.5) - angle * angle / T(24.0))
        k2 = (angle - wp.sin(angle)) / (angle * angle * angle)
        k2 = pick(small, angle, k2, T(1.0) / T(6.0) - angle * angle / T(120.0))
        rg = wp.cross(r, g)
        rrg = wp.cross(r, rg)
        return g + k1 * rg + k2 * rrg, g + (T(1.0) - k2 * angle * angle) * rg + k1 * rrg

    @wp.func
    def log_quat(q: quat):
        """Return the rotation vector of the unit quaternion q, at most pi long; the same for q and -q."""
        v = vec3(q[0], q[1], q[2])
        s = wp.length(v)
        scale = pick(T(1e-3), s, T(2.0) * wp.atan2(s, wp.abs(q[3])) / s, T(2.0) + s * s / T(3.0))
        return v * pick(q[3], T(0.0), -scale, scale)

    @wp.func
    def log_adjoint(r: vec3, g: vec3):
        """Return the adjoint of log(exp(r) exp(d)) with respect to d at d = 0: the inverse of J_r(r)' times g."""
        angle = wp.length(r)
        k2 = (T(1.0) - T(0.5) * angle / wp.tan(T(0.5) * angle)) / (angle * angle)
        k2 = pick(T(2e-2), angle, k2, T(1.0) / T(12.0) + angle * angle / T(720.0))
        rg = wp.cross(r, g)
        return g - T(0.5) * rg + k2 * wp.cross(r, rg)

    @wp.func
    def to_tangent(q: quat, g: quat):
        """Apply the transpose of dq = q (d, 0) / 2, a rotation of q by the body-frame rotation vector d, to g."""
        turn = wp.quat_inverse(q) * g
        return T(0.5) * vec3(turn[0], turn[1], turn[2])

    @wp.func
    def from_tangent(q: quat, g: vec3):
        """Return the gradient of a quaternion that is normalised before use: tangent, and scaled by 1/|q|."""
        return (wp.normalize(q) * quat(g[0], g[1], g[2], T(0.0))) * (T(2.0) / wp.length(q))

    return functions(locals())

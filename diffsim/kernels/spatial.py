"""Spatial algebra (Featherstone 2008) beyond Warp's builtins: (angular, linear) in world axes.

Warp has the rest: spatial_top/bottom, spatial_cross (motion x motion), spatial_cross_dual (motion x* force), skew.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import types


@cache
def spatial(dtype: type) -> SimpleNamespace:
    t = types(dtype)
    T, vec3, vec6, mat3, quat = dtype, t.vec3, t.vec6, t.mat3, t.quat

    @wp.func
    def join(a: vec3, b: vec3):
        return vec6(a[0], a[1], a[2], b[0], b[1], b[2])

    @wp.func
    def force_at(p: vec3, f: vec3):
        """The wrench of a force f through the point p; also the adjoint of point_velocity."""
        return join(wp.cross(p, f), f)

    @wp.func
    def point_velocity(v: vec6, p: vec3):
        return wp.spatial_bottom(v) + wp.cross(wp.spatial_top(v), p)

    @wp.func
    def momentum(mass: T, com: vec3, inertia: mat3, v: vec6):
        """Rigid-body inertia (about its centre of mass) times a motion vector."""
        p = mass * point_velocity(v, com)
        return join(inertia * wp.spatial_top(v) + wp.cross(com, p), p)

    @wp.func
    def exp_quat(r: vec3):
        """The quaternion of the rotation vector r, exact and smooth at 0."""
        angle = wp.length(r)
        s = T(0.5) - angle * angle / T(48.0)
        if angle > T(1e-3):
            s = wp.sin(T(0.5) * angle) / angle
        return quat(s * r[0], s * r[1], s * r[2], wp.cos(T(0.5) * angle))

    return SimpleNamespace(
        join=join, force_at=force_at, point_velocity=point_velocity, momentum=momentum, exp_quat=exp_quat
    )

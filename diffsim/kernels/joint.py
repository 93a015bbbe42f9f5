"""The passive force of a hinge or slide: spring, damper and limit (Eq. 4), with its derivatives beside it."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import types


@cache
def joint_law(dtype: type, stiffness: bool, damping: bool, limit: bool) -> SimpleNamespace:
    t = types(dtype)
    T, Model = dtype, t.Model
    vec2 = wp.types.vector(2, T)

    @wp.func
    def limit_force(m: Model, i: int, q: T, qd: T):
        """It pushes back into the range and never pulls, however fast the joint returns."""
        force = T(0.0)
        if q < m.lower[i]:
            force = wp.max(m.k_limit[i] * (m.lower[i] - q) - m.d_limit[i] * qd, T(0.0))
        if q > m.upper[i]:
            force = wp.min(m.k_limit[i] * (m.upper[i] - q) - m.d_limit[i] * qd, T(0.0))
        return force

    @wp.func
    def passive_force(m: Model, i: int, q: T, qd: T):
        force = T(0.0)
        if wp.static(stiffness):
            force = force - m.stiffness[i] * (q - m.spring_ref[i])
        if wp.static(damping):
            force = force - m.damping[i] * qd
        if wp.static(limit):
            force = force + limit_force(m, i, q, qd)
        return force

    @wp.func
    def passive_gain(m: Model, i: int, q: T, qd: T):
        """(d force / d q, d force / d qd)."""
        kq = T(0.0)
        kv = T(0.0)
        if wp.static(stiffness):
            kq = kq - m.stiffness[i]
        if wp.static(damping):
            kv = kv - m.damping[i]
        if wp.static(limit):
            if limit_force(m, i, q, qd) != T(0.0):
                kq = kq - m.k_limit[i]
                kv = kv - m.d_limit[i]
        return vec2(kq, kv)

    return SimpleNamespace(passive_force=passive_force, passive_gain=passive_gain)

"""The contact law of one sphere on the ground plane, Eq. 3, and its adjoint.

With depth d < 0, point velocity v and its normal component v_z (the rate of d),

    f_n = (k_d v_z - k_n) d,   f_t = -c v_t,   c = min(k_t, mu f_n / |v_t|),

active where f_n > 0, so the ground never pulls: for k_d v_z >= k_n the sphere leaves faster than the ground can push.
At zero slip c = k_t without a division.

Implicit step: the law is linear in the acceleration a of the point, f = f(d + theta h v_z, v) - B a, with
B = diag(h c, h c, theta h^2 k_n - h k_d d) and c lagged; the explicit law is B = 0, h_implicit = theta = 0.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import types


@cache
def contact_law(dtype: type) -> SimpleNamespace:
    t = types(dtype)
    T, vec3, vec4, Law = dtype, t.vec3, t.vec4, t.Law

    @wp.func
    def touches(law: Law, d: T, v: vec3):
        return d < T(0.0) and law.k_d * v[2] < law.k_n

    @wp.func
    def friction_viscosity(law: Law, f_n: T, v: vec3):
        """(c, 1 if sliding else 0)."""
        speed = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        c = law.k_t
        sliding = T(0.0)
        if law.k_t * speed > law.mu * f_n:
            c = law.mu * f_n / speed
            sliding = T(1.0)
        return c, sliding

    @wp.func
    def contact_force(law: Law, d: T, v: vec3):
        """Force on the sphere, and the effective viscosity c of friction, as (f, c)."""
        f_n = (law.k_d * v[2] - law.k_n) * d
        c, sliding = friction_viscosity(law, f_n, v)
        return vec4(-c * v[0], -c * v[1], f_n, c)

    @wp.func
    def contact_resistance(law: Law, d: T, c: T, h: T, theta: T):
        """The diagonal of B."""
        return vec3(h * c, h * c, theta * h * h * law.k_n - h * law.k_d * d)

    @wp.func
    def contact_adjoint(law: Law, d: T, v: vec3, a: vec3, g: vec3, h: T, theta: T):
        """(adjoint of v, adjoint of d at the start of the step) of g . f(d + theta h v_z, v, a); h = 0 if explicit."""
        s = law.k_d * v[2] - law.k_n
        f_n = s * d
        c, sliding = friction_viscosity(law, f_n, v)
        g_n = g[2]
        gx = -c * g[0]
        gy = -c * g[1]
        if sliding > T(0.0):
            # f_t - h c a_t = -c (v_t + h a_t) with c = mu f_n / |v_t|
            speed2 = v[0] * v[0] + v[1] * v[1]
            g_c = -(g[0] * (v[0] + h * a[0]) + g[1] * (v[1] + h * a[1]))
            g_n = g_n + g_c * law.mu / wp.sqrt(speed2)
            gx = gx - g_c * c * v[0] / speed2
            gy = gy - g_c * c * v[1] / speed2
        g_d = g_n * s + g[2] * h * law.k_d * a[2]
        return vec4(gx, gy, g_n * law.k_d * d + theta * h * g_d, g_d)

    @wp.func
    def contact_constants_adjoint(law: Law, d: T, v: vec3, a: vec3, g: vec3, h: T, theta: T):
        """The adjoints of (k_n, k_d, k_t, mu); arguments as of contact_adjoint."""
        f_n = (law.k_d * v[2] - law.k_n) * d
        c, sliding = friction_viscosity(law, f_n, v)
        g_c = -(g[0] * (v[0] + h * a[0]) + g[1] * (v[1] + h * a[1]))
        g_n = g[2]
        g_mu = T(0.0)
        if sliding > T(0.0):
            speed = wp.sqrt(v[0] * v[0] + v[1] * v[1])
            g_n = g_n + g_c * law.mu / speed
            g_mu = g_c * f_n / speed
            g_c = T(0.0)
        g_kn = -g_n * d - g[2] * theta * h * h * a[2]
        return vec4(g_kn, d * (g_n * v[2] + g[2] * h * a[2]), g_c, g_mu)

    return SimpleNamespace(
        touches=touches,
        contact_force=contact_force,
        contact_resistance=contact_resistance,
        contact_adjoint=contact_adjoint,
        contact_constants_adjoint=contact_constants_adjoint,
    )

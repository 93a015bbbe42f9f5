"""The tension of a Hill-type muscle, with the curves of MuJoCo's <muscle>, and its derivatives.

    T = u f_L(l) f_V(v) + F f_P(l)

with u the maximum force F times the activation, and l and v the length and speed of the fibre, linear in those of the
muscle's whole path. Both are in units in which f_L(1) = f_V(0) = 1 are the curves' maximum and value at rest.
"""

from functools import cache

import warp as wp

from diffsim.kernels.model import types
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks


@cache
def hill_law(spec: KernelSpec) -> wp.Function:
    t = types(spec)
    T, U, vec4, Model, pick = t.T, t.U, t.vec4, t.Model, blocks(spec).pick
    zero, one = T(0.0), T(1.0)

    @wp.func
    def width(x: U):
        """Of a parabola, as MuJoCo bounds it: a curve may have none there (fvmax 1)."""
        return T(wp.max(x, U(1e-15)))

    @wp.func
    def hill(m: Model, k: int, u: T, path: T, path_rate: T):
        """(T, dT/du, dT/dl, dT/dl') of muscle k."""
        p = m.hill[k]  # length within links; of the fibre: l = p1 path + p2, v = p3 path_rate; the curves' corners; F
        l = T(p[1]) * path + T(p[2])
        v = T(p[3]) * path_rate
        # f_L: on either side of 1, two parabolas between the end of the range and f_L(1) = 1, which meet half-way
        way = pick(one, l, T(p[5]) - l, l - T(p[4]))  # from the end of the range
        high = width(U(0.5) * (p[5] - U(1.0)))
        half = pick(one, l, high, width(U(0.5) * (U(1.0) - p[4])))
        z = wp.max(way / half, zero)
        f = pick(one, z, one - T(0.5) * (T(2.0) - z) * (T(2.0) - z), T(0.5) * z * z)
        s = wp.min(z, T(2.0) - z) / pick(one, l, -half, half)
        # f_V: a parabola while the fibre shortens, f_V(0) = 1, another up to fvmax while it lengthens
        y = width(p[7] - U(1.0))
        shortens = wp.max(v + one, zero)
        rest = wp.max(y - v, zero)
        f_v = pick(zero, v, T(p[7]) - rest * rest / y, shortens * shortens)
        s_v = pick(zero, v, T(2.0) * rest / y, T(2.0) * shortens)
        # f_P: a parabola, then a straight line; F f_P
        x = wp.max((l - one) / high, zero)
        passive = T(p[8] * p[6]) * pick(one, x, x - T(0.5), T(0.5) * x * x)
        s_p = T(p[8] * p[6]) * wp.min(x, one) / high
        return vec4(u * f * f_v + passive, f * f_v, (u * s * f_v + s_p) * T(p[1]), u * f * s_v * T(p[3]))

    return hill

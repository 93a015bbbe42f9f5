"""The tension of a Hill-type muscle, with the curves of MuJoCo's <muscle>, and its derivatives.

    T = u f_L(l) f_V(v) + F f_P(l)

with u the maximum force F times the activation, and l and v the length and speed of the fibre, linear in those of the
muscle's whole path. Both are in units in which f_L(1) = f_V(0) = 1 are the curves' maximum and value at rest.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import types


@cache
def hill_law(dtype: type) -> SimpleNamespace:
    t = types(dtype)
    T, vec4, Model = dtype, t.vec4, t.Model

    @wp.func
    def hill(m: Model, k: int, u: T, path: T, path_rate: T):
        """(T, dT/du, dT/dl, dT/dl') of muscle k."""
        p = m.hill[k]  # length within links; of the fibre: l = p1 path + p2, v = p3 path_rate; the curves' corners; F
        l = p[1] * path + p[2]
        v = p[3] * path_rate
        lmin = p[4]
        lmax = p[5]
        low = T(0.5) * (lmin + T(1.0))
        high = T(0.5) * (T(1.0) + lmax)
        # f_L: four parabolas between lmin and lmax, f_L(1) = 1; s is the slope
        f = T(0.0)
        s = T(0.0)
        if l > lmin and l <= low:
            f = T(0.5) * (l - lmin) * (l - lmin) / ((low - lmin) * (low - lmin))
            s = (l - lmin) / ((low - lmin) * (low - lmin))
        elif l > low and l <= T(1.0):
            f = T(1.0) - T(0.5) * (T(1.0) - l) * (T(1.0) - l) / ((T(1.0) - low) * (T(1.0) - low))
            s = (T(1.0) - l) / ((T(1.0) - low) * (T(1.0) - low))
        elif l > T(1.0) and l <= high:
            f = T(1.0) - T(0.5) * (l - T(1.0)) * (l - T(1.0)) / ((high - T(1.0)) * (high - T(1.0)))
            s = (T(1.0) - l) / ((high - T(1.0)) * (high - T(1.0)))
        elif l > high and l < lmax:
            f = T(0.5) * (lmax - l) * (lmax - l) / ((lmax - high) * (lmax - high))
            s = (l - lmax) / ((lmax - high) * (lmax - high))
        # f_V: a parabola while the fibre shortens, f_V(0) = 1, another up to fvmax while it lengthens
        y = p[7] - T(1.0)
        f_v = T(0.0)
        s_v = T(0.0)
        if v > T(-1.0) and v <= T(0.0):
            f_v = (v + T(1.0)) * (v + T(1.0))
            s_v = T(2.0) * (v + T(1.0))
        elif v > T(0.0) and v <= y:
            f_v = p[7] - (y - v) * (y - v) / y
            s_v = T(2.0) * (y - v) / y
        elif v > y:
            f_v = p[7]
        # f_P: a parabola, then a straight line; F f_P
        passive = T(0.0)
        s_p = T(0.0)
        if l > T(1.0):
            z = (l - T(1.0)) / (high - T(1.0))
            passive = p[8] * p[6] * wp.where(l <= high, T(0.5) * z * z, z - T(0.5))
            s_p = p[8] * p[6] * wp.min(z, T(1.0)) / (high - T(1.0))
        return vec4(u * f * f_v + passive, f * f_v, (u * s * f_v + s_p) * p[1], u * f * s_v * p[3])

    return SimpleNamespace(hill=hill)

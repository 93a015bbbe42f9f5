"""A row of MuJoCo's regularised constraints: contact, joint limits, dry friction, and rows between two bodies.

Its force depends on the acceleration a of the robot by

    jar = J a + b v + k d(r) r,   D = d(r) / ((1 - d(r)) w),

with v the row's velocity, r < 0 its violation of the margin, d(r) its impedance (`solimp`), k and b from `solref`, and
w its inverse weight. J a - jar is MuJoCo's aref. MuJoCo leaves dJ/dt v out of J a. So J a is the velocity of the twists
B that the links would have if the joints' velocities were their accelerations. A limit has the force -D jar where
jar < 0, dry friction -D jar bounded by +-eta (limits.py), a contact the three numbers of cone.py (ground.py). All are
linear in a within their zones, with slope -H. So a Newton step of MuJoCo's convex problem,

    (M + J'HJ) (a_new - a) = tau + J'f(a) - M a,

is one pass of the articulated-body algorithm with each contact's block X'HX added to its link's inertia, and D to its
joint's: `ground.add_contacts` and `limits.joint_constraint`.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def impedance_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a row's impedance, which the ground, limits and rows between bodies share."""
    t, pick = types(spec), blocks(spec).pick
    T, U, vec3, vec4, mat3, Params, Trial = t.T, t.U, t.vec3, t.vec4, t.mat3, t.scene.vec11, t.Trial

    @wp.func
    def impedance_row(c: Params, stiffness: T, r: T):
        """Return (D, D' / D, k d r, (k d r)'), primes with respect to r <= 0; stiffness is a factor of k."""
        x = wp.min(-r / T(c[7]), T(1.0))
        middle, power = T(c[8]), T(c[9])
        if c[9] == U(2.0):
            low = x * x / middle
            low_slope = T(2.0) * x / middle
            high = T(1.0) - (T(1.0) - x) * (T(1.0) - x) / (T(1.0) - middle)
            high_slope = T(2.0) * (T(1.0) - x) / (T(1.0) - middle)
        else:
            low_slope = power * wp.pow(x / middle, power - T(1.0))
            high_slope = power * wp.pow((T(1.0) - x) / (T(1.0) - middle), power - T(1.0))
            low = low_slope * x / power
            high = T(1.0) - high_slope * (T(1.0) - x) / power
        rise = T(c[6]) - T(c[5])
        d = T(c[5]) + rise * pick(middle, x, high, low)
        slope = -rise / T(c[7]) * pick(x, T(1.0), pick(middle, x, high_slope, low_slope), T(0.0))
        k = stiffness * T(c[0])
        rest = T(1.0) - d
        return vec4(d / (rest * T(c[4])), slope / (d * rest), k * d * r, k * (d + slope * r))

    @wp.func
    def acceleration_for(force_error: vec3, w: T, H: mat3):
        """Return (1 / w + H)^-1 force_error, the acceleration that corrects the error of a force.

        I + w H has pivots of 1 or more.
        """
        G = w * H
        x = w * force_error
        d = T(1.0) / (T(1.0) + G[0, 0])
        y = d * G[1, 0]
        z = d * G[2, 0]
        e = G[2, 1] - z * G[1, 0]
        x[1] = x[1] - y * x[0]
        x[2] = x[2] - z * x[0]
        c = T(1.0) / wp.max(T(1.0) + G[1, 1] - y * G[1, 0], T(1.0))
        v = c * e
        x[2] = (x[2] - v * x[1]) / wp.max(T(1.0) + G[2, 2] - z * G[2, 0] - v * e, T(1.0))
        x[1] = c * x[1] - v * x[2]
        x[0] = d * x[0] - y * x[1] - z * x[2]
        return x

    @wp.func
    def add_trials(x: Trial, y: Trial):
        """Return the sum of two trials' numbers."""
        x.slope = x.slope + y.slope
        x.linear = x.linear + y.linear
        x.curvature = x.curvature + y.curvature
        x.error_sq = x.error_sq + y.error_sq
        x.stiffness = x.stiffness + y.stiffness
        return x

    return functions(locals())

"""Bounds of the actuators' force on a joint: forcerange and actuatorfrcrange.

Such actuators have the force motor + k (r - q) - b q', clamped to them. At a bound the force is constant, and their
spring and damper have no part in B (joint.py); `unclamped` is 0 there and 1 elsewhere.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def clamp_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the force of a joint's actuators within its bounds."""
    t = types(spec)
    T, Model, pick = t.T, t.Model, blocks(spec).pick
    CLAMP = "clamp" in spec.features

    @wp.func
    def unclamped_force(m: Model, i: int, motor: T, q: T, qd: T):
        """Return the actuators' force before it is clamped."""
        return motor + T(m.servo_stiffness[i]) * (T(m.servo_ref[i]) - q) - T(m.servo_damping[i]) * qd

    @wp.func
    def clamped(force: T, low: T, high: T):
        """Return the force within its bounds. A NaN stays one, unlike with min and max, so that it is contained."""
        return pick(high, force, high, pick(force, low, low, force))

    @wp.func
    def actuator_force(m: Model, i: int, motor: T, q: T, qd: T):
        """Return the force of the joint's actuators."""
        force = motor
        if wp.static(CLAMP):
            force = clamped(unclamped_force(m, i, motor, q, qd), T(m.force_low[i]), T(m.force_high[i]))
        return force

    @wp.func
    def actuator_unclamped(m: Model, i: int, motor: T, q: T, qd: T):
        """Return 1 where that force is within its bounds, 0 where it is at one."""
        force = unclamped_force(m, i, motor, q, qd)
        return pick(T(m.force_low[i]), force, pick(force, T(m.force_high[i]), T(1.0), T(0.0)), T(0.0))

    return functions(locals())

"""Rows of joints: MuJoCo's limits and dry friction (impedance.py), and their derivatives."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.impedance import impedance_law
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def joint_limits(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a joint's limit and dry friction."""
    t, pick, impedance_row = types(spec), blocks(spec).pick, impedance_law(spec).impedance_row
    T, vec2, vec3, vec4, Model, Lane = t.T, t.vec2, t.vec3, t.vec4, t.Model, t.Lane
    (LIMIT, LOSS), VARIED = spec.has("limit frictionloss"), spec.varied

    @wp.func
    def limit_row(m: Model, here: Lane, i: int, q: T):
        """Return the limit's impedance_row, with D = 0 within the range, and the sign of its J."""
        params = m.limit_params[i]
        low = q - T(m.lower[i])
        high = T(m.upper[i]) - q
        r = wp.min(low, high) - T(params[10])
        stiffness = T(1.0)
        if wp.static(VARIED):
            stiffness = here.k_limit
        state = impedance_row(params, stiffness, wp.min(r, T(0.0)))
        active = pick(r, T(0.0), T(1.0), T(0.0))
        return vec4(active * state[0], state[1], state[2], state[3]), pick(low, high, T(1.0), T(-1.0))

    @wp.func
    def limit_damping(m: Model, here: Lane, i: int):
        """Return b of joint i's limit."""
        b = T(m.limit_params[i][1])
        if wp.static(VARIED):
            b = wp.sqrt(here.k_limit) * b
        return b

    @wp.func
    def limit_state(m: Model, here: Lane, i: int, q: T, qd: T):
        """Return the limit's (D, jar without acceleration, sign of J)."""
        state, sign = limit_row(m, here, i, q)
        return vec3(state[0], sign * limit_damping(m, here, i) * qd + state[2], sign)

    @wp.func
    def joint_constraint(m: Model, i: int, limit: vec3, qd: T, qdd: T, sticking: T):
        """Return the force of the limit and of dry friction on the joint, and minus its derivative in qdd.

        Where sticking is 1, the limit has its slope whatever jar is.
        """
        force = T(0.0)
        slope = T(0.0)
        if wp.static(LIMIT):
            jar = limit[2] * qdd + limit[1]
            slope = pick(jar, T(0.0), limit[0], sticking * limit[0])
            force = -limit[2] * slope * jar
        if wp.static(LOSS):
            loss = m.joint_loss[i]
            f = -T(loss[1]) * (qdd + T(loss[2]) * qd)
            eta = T(loss[0])
            force = force + wp.max(wp.min(f, eta), -eta)
            slope = slope + pick(wp.abs(f), eta, T(loss[1]), T(0.0))
        return vec2(force, slope)

    @wp.func
    def joint_derivatives(m: Model, here: Lane, i: int, q: T, qd: T, qdd: T):
        """Differentiate that force with respect to q and qd."""
        derivatives = vec2()
        if wp.static(LIMIT):
            state, sign = limit_row(m, here, i, q)
            b = limit_damping(m, here, i)
            jar = sign * (qdd + b * qd) + state[2]
            D = pick(jar, T(0.0), state[0], T(0.0))
            derivatives = -D * vec2(state[3] + jar * state[1], b)
        if wp.static(LOSS):
            loss = m.joint_loss[i]
            f = T(loss[1]) * (qdd + T(loss[2]) * qd)
            derivatives[1] = derivatives[1] - pick(wp.abs(f), T(loss[0]), T(loss[1]) * T(loss[2]), T(0.0))
        return derivatives

    return functions(locals())

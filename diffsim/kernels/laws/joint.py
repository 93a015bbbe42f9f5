"""The force of a hinge or slide: motors, spring, damper and limit (Eq. 4), and its derivatives.

Where q violates a bound by x > 0 and returns with velocity v, the limit's force towards the range is

    f = max(k_limit - d_limit v, 0) x.

As in contact, damping grows with the depth, and a limit never pulls. With the velocity q' and the acceleration a,

Implicit step: f(q, q') - B a with B = h (b + d_limit x), of the whole passive force; x is lagged. An inactive limit
has no part in B. The explicit law is B = 0, h = 0.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.clamp import clamp_law
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def joint_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the force of a joint, and its derivatives."""
    t = types(spec)
    T, Model, Lane = t.T, t.Model, t.Lane
    vec2, block = t.vec2, blocks(spec)
    pick = block.pick
    STIFFNESS, DAMPING, LIMIT, CLAMP, TENDON = spec.has("stiffness damping limit clamp tendon")
    LIMIT = LIMIT and not spec.constrained
    VARIED, NU, EXPLICIT_SERVOS = spec.varied, spec.nu, "explicit_servos" in spec.features

    def motors(rows: type) -> wp.Function:
        @wp.func
        def motors_forward(m: Model, here: Lane, ctrl: t.array2, links: rows):
            """Add the motors' forces to a lane's links; motors of other lanes' links are in slot 0."""
            for k in range(NU):
                i = m.motor_slot[here.lane * NU + k]
                links[i].motor = links[i].motor + T(m.gear[k]) * block.read(ctrl, here.e, k) + T(m.motor_bias[k])
            if wp.static(VARIED):
                for i in range(1, here.n):
                    links[i].motor = here.motor * links[i].motor

        return motors_forward

    actuator_force, actuator_unclamped = clamp_law(spec).actuator_force, clamp_law(spec).actuator_unclamped
    motors_forward, motors_backward = motors(t.Motions), motors(t.Nodes) if CLAMP or TENDON else None

    @wp.func
    def damping(m: Model, i: int, unclamped: T):
        """Return the joint's damping, without its limit's."""
        result = T(m.damping[i])
        if wp.static(CLAMP):
            result = result + unclamped * T(m.servo_damping[i])
        return result

    @wp.func
    def end_damping(m: Model, i: int, unclamped: T):
        """Return the part of it that acts on the velocity at the end of MuJoCo's step."""
        if wp.static(EXPLICIT_SERVOS):
            return T(m.damping[i])
        return damping(m, i, unclamped)

    @wp.func
    def limit_violation(m: Model, i: int, q: T):
        """Return the signed distance from q back to the bound that it violates; 0 within the range."""
        lower = T(m.lower[i])
        upper = T(m.upper[i])
        return pick(upper, q, upper - q, pick(q, lower, lower - q, T(0.0)))

    @wp.func
    def limit_constants(m: Model, here: Lane, i: int):
        """Return the limit's k_limit and d_limit."""
        k = T(m.k_limit[i])
        d = T(m.d_limit[i])
        if wp.static(VARIED):
            k = here.k_limit * k
            d = here.d_limit * d
        return k, d

    @wp.func
    def return_velocity(violation: T, velocity: T):
        """Return the velocity towards the range."""
        return pick(T(0.0), violation, velocity, -velocity)

    @wp.func
    def limit_active(k: T, d: T, violation: T, qd: T):
        """Return 1 where the limit has a force: beyond a bound, and not leaving it too fast; else 0."""
        return pick(d * return_velocity(violation, qd), k, pick(T(0.0), wp.abs(violation), T(1.0), T(0.0)), T(0.0))

    @wp.func
    def passive_force(m: Model, here: Lane, i: int, q: T, qd: T):
        """Return the force of spring, damper and limit."""
        force = T(0.0)
        if wp.static(STIFFNESS):
            force = force - T(m.stiffness[i]) * (q - T(m.spring_ref[i]))
        if wp.static(DAMPING):
            force = force - T(m.damping[i]) * qd
        if wp.static(LIMIT):
            violation = limit_violation(m, i, q)
            k, d = limit_constants(m, here, i)
            force = force + limit_active(k, d, violation, qd) * (k - d * return_velocity(violation, qd)) * violation
        return force

    @wp.func
    def force(m: Model, here: Lane, i: int, motor: T, q: T, qd: T):
        """Return all of the joint's force."""
        return actuator_force(m, i, motor, q, qd) + passive_force(m, here, i, q, qd)

    @wp.func
    def resistance(m: Model, here: Lane, i: int, q: T, qd: T, unclamped: T):
        """Return minus the force's derivatives in q and qd, x being lagged; B is h times the second."""
        kq = T(0.0)
        kv = T(0.0)
        if wp.static(STIFFNESS):
            kq = kq + T(m.stiffness[i])
        if wp.static(DAMPING):
            kv = kv + damping(m, i, unclamped)
        if wp.static(CLAMP):
            kq = kq + unclamped * T(m.servo_stiffness[i])
        if wp.static(LIMIT):
            violation = limit_violation(m, i, q)
            k, d = limit_constants(m, here, i)
            active = limit_active(k, d, violation, qd)
            kq = kq + active * k
            kv = kv + active * d * wp.abs(violation)
        return vec2(kq, kv)

    @wp.func
    def derivatives(m: Model, here: Lane, i: int, q: T, qd: T, end_qd: T, unclamped: T):
        """Return (d force / d q, d force / d qd), -B a included; end_qd is qd + h a, or qd if explicit."""
        resisted = resistance(m, here, i, q, qd, unclamped)
        kq = -resisted[0]
        if wp.static(LIMIT):
            violation = limit_violation(m, i, q)
            k, d = limit_constants(m, here, i)
            kq = kq + limit_active(k, d, violation, qd) * d * return_velocity(violation, end_qd)
        return vec2(kq, -resisted[1])

    return functions(locals())

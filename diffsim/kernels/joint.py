"""The force of a hinge or slide: motors, spring, damper and limit (Eq. 4), with its derivatives beside it.

With q beyond a bound by x > 0, and the rate v at which it returns, a limit pushes back with

    f = max(k_limit - d_limit v, 0) x,

as contact does: the damper grows with the depth, and a limit never pulls. With q' the rate and a the acceleration,

Implicit step: f(q, q') - B a with B = h (b + d_limit x), of the whole passive force; x is lagged. Where the limit lets
go it has no part in B. The explicit law is B = 0, h = 0.

Actuators with bounds push with motor + k (r - q) - b q', kept within them. At a bound the force is constant, and their
spring and damper have no part in B; `free` is 0 there and 1 elsewhere.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import functions, types
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks


@cache
def joint_law(spec: KernelSpec) -> SimpleNamespace:
    t = types(spec)
    T, Model, Lane = t.T, t.Model, t.Lane
    vec2, block = t.vec2, blocks(spec)
    pick = block.pick
    STIFFNESS, DAMPING, LIMIT, CLAMP = spec.has("stiffness damping limit clamp")
    LIMIT = LIMIT and not spec.constrained
    VARIED, NU = spec.varied, spec.nu

    def drives(rows: type) -> wp.Function:
        @wp.func
        def drive(m: Model, here: Lane, ctrl: t.array2, links: rows):
            """Adds the motors' forces to the links' of a lane; what drives other lanes' links is in slot 0."""
            for k in range(NU):
                i = m.motor_slot[here.lane * NU + k]
                links[i].motor = links[i].motor + T(m.gear[k]) * block.read(ctrl, here.e, k) + T(m.motor_bias[k])
            if wp.static(VARIED):
                for i in range(1, here.n):
                    links[i].motor = here.motor * links[i].motor

        return drive

    drive, drive_again = drives(t.Motions), drives(t.Nodes) if CLAMP else None

    @wp.func
    def unbounded(m: Model, i: int, motor: T, q: T, qd: T):
        return motor + T(m.servo_stiffness[i]) * (T(m.servo_ref[i]) - q) - T(m.servo_damping[i]) * qd

    @wp.func
    def actuation(m: Model, i: int, motor: T, q: T, qd: T):
        """The force of the joint's actuators."""
        force = motor
        if wp.static(CLAMP):
            force = wp.max(wp.min(unbounded(m, i, motor, q, qd), T(m.force_high[i])), T(m.force_low[i]))
        return force

    @wp.func
    def actuation_free(m: Model, i: int, motor: T, q: T, qd: T):
        """1 where that force is within its bounds, 0 where it is at one."""
        force = unbounded(m, i, motor, q, qd)
        return pick(T(m.force_low[i]), force, pick(force, T(m.force_high[i]), T(1.0), T(0.0)), T(0.0))

    @wp.func
    def damping(m: Model, i: int, free: T):
        """What damps the joint, besides its limit."""
        result = T(m.damping[i])
        if wp.static(CLAMP):
            result = result + free * T(m.servo_damping[i])
        return result

    @wp.func
    def way_back(m: Model, i: int, q: T):
        """From q to the bound that it is beyond; 0 within the range."""
        lower = T(m.lower[i])
        upper = T(m.upper[i])
        return pick(upper, q, upper - q, pick(q, lower, lower - q, T(0.0)))

    @wp.func
    def limit_constants(m: Model, here: Lane, i: int):
        k = T(m.k_limit[i])
        d = T(m.d_limit[i])
        if wp.static(VARIED):
            k = here.k_limit * k
            d = here.d_limit * d
        return k, d

    @wp.func
    def returning(way: T, rate: T):
        """The rate at which the joint returns."""
        return pick(T(0.0), way, rate, -rate)

    @wp.func
    def pushes(k: T, d: T, way: T, qd: T):
        """1 where the limit acts: beyond a bound, and not left too fast; else 0."""
        return pick(d * returning(way, qd), k, pick(T(0.0), wp.abs(way), T(1.0), T(0.0)), T(0.0))

    @wp.func
    def passive_force(m: Model, here: Lane, i: int, q: T, qd: T):
        force = T(0.0)
        if wp.static(STIFFNESS):
            force = force - T(m.stiffness[i]) * (q - T(m.spring_ref[i]))
        if wp.static(DAMPING):
            force = force - T(m.damping[i]) * qd
        if wp.static(LIMIT):
            way = way_back(m, i, q)
            k, d = limit_constants(m, here, i)
            force = force + pushes(k, d, way, qd) * (k - d * returning(way, qd)) * way
        return force

    @wp.func
    def force(m: Model, here: Lane, i: int, motor: T, q: T, qd: T):
        """All of the joint's force."""
        return actuation(m, i, motor, q, qd) + passive_force(m, here, i, q, qd)

    @wp.func
    def resistance(m: Model, here: Lane, i: int, q: T, qd: T, free: T):
        """Minus the derivatives of the force with respect to q and qd, x being lagged; B is h times the second."""
        kq = T(0.0)
        kv = T(0.0)
        if wp.static(STIFFNESS):
            kq = kq + T(m.stiffness[i])
        if wp.static(DAMPING):
            kv = kv + damping(m, i, free)
        if wp.static(CLAMP):
            kq = kq + free * T(m.servo_stiffness[i])
        if wp.static(LIMIT):
            way = way_back(m, i, q)
            k, d = limit_constants(m, here, i)
            on = pushes(k, d, way, qd)
            kq = kq + on * k
            kv = kv + on * d * wp.abs(way)
        return vec2(kq, kv)

    @wp.func
    def gain(m: Model, here: Lane, i: int, q: T, qd: T, end_rate: T, free: T):
        """(d force / d q, d force / d qd), -B a included; end_rate is qd + h a, or qd if explicit."""
        resisted = resistance(m, here, i, q, qd, free)
        kq = -resisted[0]
        if wp.static(LIMIT):
            way = way_back(m, i, q)
            k, d = limit_constants(m, here, i)
            kq = kq + pushes(k, d, way, qd) * d * returning(way, end_rate)
        return vec2(kq, -resisted[1])

    @wp.func
    def limit_constants_gain(m: Model, here: Lane, i: int, q: T, qd: T, end_rate: T):
        """d force / d factor of (k_limit, d_limit); arguments as of gain."""
        way = way_back(m, i, q)
        k, d = limit_constants(m, here, i)
        on = pushes(k, d, way, qd)
        return on * vec2(T(m.k_limit[i]) * way, -T(m.d_limit[i]) * wp.abs(way) * end_rate)

    return functions(locals())

"""One control step: all substeps of all environments in one launch.

On a GPU an environment has one thread or several (lanes.py). On a CPU one thread serves a block of them (wide.py).

A substep is Featherstone's articulated-body algorithm (RBDA, Table 7.1) about the carrier's current position in world
axes, then semi-implicit Euler with the exact quaternion exponential. Its factorisation (U and 1/d of each joint, the
base's Cholesky factor) is what the paper caches as the factored mass matrix; the adjoint solves with it again.
"""

from functools import cache

import warp as wp

from diffsim.kernels.constraint import constraint_law
from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.factors import environment_law
from diffsim.kernels.force import external_force
from diffsim.kernels.joint import joint_law
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.link import link_law
from diffsim.kernels.model import types
from diffsim.kernels.muscle import muscle_law
from diffsim.kernels.solve import base_inertia
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import MAX_SPEED, KernelSpec
from diffsim.kernels.wide import blocks, module_options

SEARCHES = 3  # evaluations of a line search, and the share of its first slope that is near enough to 0
SLOPE = 0.05


@cache
def forward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec2, vec3, vec6, quat = t.T, t.vec2, t.vec3, t.vec6, t.quat
    Model, Law, law_of = t.Model, t.Law, environment_law(spec)
    join, exp_quat, store, link_of, qpos_adr = sp.join, sp.exp_quat, kin.store, kin.link_of, kin.qpos_adr
    read, write, pick = block.read, block.write, block.pick
    link, force, joint = link_law(spec), external_force(spec), joint_law(spec)
    muscle, base, constraint = muscle_law(spec), base_inertia(spec), constraint_law(spec)
    CONTACT, MOTOR, CLAMP, MUSCLE = (name in spec.features for name in ("contact", "motor", "clamp", "muscle"))
    NU, FLOATING, IMPLICIT, FORCED = spec.nu, spec.floating, spec.implicit, spec.forced > 0
    # With MuJoCo's constraints a substep takes several solves.
    CONSTRAINED, SOLVES, DAMPED = spec.constrained, spec.solves, spec.damped
    SEARCH = CONSTRAINED and "frictionloss" in spec.features
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    NV, VADR = spec.nv, spec.dof0 - 1  # link i's joint in qvel is VADR + i
    NBALL, LIMIT = spec.nball, MAX_SPEED
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.slots

    Load, Link, Lane = t.Load, t.Link, t.Lane

    @wp.func
    def too_fast(rate: T):
        """1 where a rate is beyond any imaginable one, or no number, else 0."""
        return pick(wp.abs(rate), T(LIMIT), T(0.0), T(1.0))

    @wp.func
    def hand_back(out: t.array2, start: t.array2, e: int, column: int, broken: T, value: T):
        """Writes the value, but what it was at the start to broken environments."""
        write(out, e, column, pick(T(0.0), broken, read(start, e, column), value))

    @wp.func
    def search(
        m: Model,
        law: Law,
        here: Lane,
        links: t.Links,
        B: t.vec6s,
        height: T,
        guess: t.array,
        step: t.array,
        twist: t.vec6s,
        loads: t.Loads,
    ):
        """The part of Newton's step that MuJoCo's cost is least after, or all of it where that is near.

        The cost's slope after a part of the step is (part - 1) s.Ms - s.Hs + s.f(0) - s.f(part), as of Newton's step
        s (M + H) s = s.f(0) - ...; it grows with the part, so secants between its signs find where it is zero.
        """
        inertia = T(0.0)
        for i in range(here.n):
            k = here.at + i
            a = wp.spatial_top(twist[i])
            l = wp.spatial_bottom(twist[i])
            inertia = inertia + wp.dot(a, loads[i].a * a + T(2.0) * (loads[i].b * l)) + wp.dot(l, loads[i].d * l)
            if i > 0:
                inertia = inertia + T(m.carried[k]) * T(m.armature[k]) * step[i] * step[i]
        if wp.static(THREADS_PER_ENV > 1):
            inertia = sums.add(inertia)
        start = vec2()
        low = T(0.0)
        high = T(1.0)
        at_low = T(0.0)
        at_high = T(0.0)
        part = T(0.0)
        beyond = T(1.0)
        for trial in range(1 + SEARCHES):  # the first is where the step begins
            if block.any_of(beyond):
                now = vec2()  # s.f and s.Hs of all constraints after this part of the step
                for i in range(here.n):
                    k = here.at + i
                    if wp.static(CONTACT):
                        now = now + constraint.contacts_along(m, law, k, links[i], B[i], height, twist[i], part)
                    if i > 0:
                        held = constraint.joint_constraint(
                            m, law, k, links[i].q, links[i].qd, guess[i] + part * step[i], T(0.0)
                        )
                        now = now + T(m.carried[k]) * step[i] * vec2(held[0], held[1] * step[i])
                if wp.static(THREADS_PER_ENV > 1):
                    now = vec2(sums.add(now[0]), sums.add(now[1]))
                if trial == 0:
                    start = now
                    at_low = -(inertia + start[1])
                    part = T(1.0)
                else:
                    slope = inertia * (part - T(1.0)) - start[1] + start[0] - now[0]
                    near = T(SLOPE) * (inertia + start[1])
                    low = pick(near, slope, low, part)
                    at_low = pick(near, slope, at_low, slope)
                    high = pick(near, slope, part, high)
                    at_high = pick(near, slope, slope, at_high)
                    width = wp.max(at_high - at_low, T(1e-30))
                    part = low + (high - low) * wp.min(wp.max(-at_low, T(0.0)) / width, T(1.0))
                    beyond = pick(low, T(1.0), T(1.0), T(0.0))
        return part

    @wp.kernel(module="unique", module_options=module_options(spec))
    def forward(
        # model
        m: Model,
        first: int,  # block of this launch
        seconds: t.U,  # of a substep
        implicitness: t.U,
        substeps: int,
        passes: int,  # of Newton's method, read with constraints
        start: t.Start,
        # checkpoint out: rows row0 .. row0 + substeps - 1, written if record is 1
        record: int,
        row0: int,
        ck: t.Checkpoint,
        # state out; with constraints the last column of qvel_out is how far the last pass moved the acceleration
        qpos_out: t.array2,
        qvel_out: t.array2,
        nonfinite: wp.array(dtype=wp.bool),
    ):
        h = T(seconds)
        theta = T(implicitness)
        here = kin.lane_of(m, first, wp.tid())
        e = here.e
        lane = here.lane
        at = here.at
        n = here.n
        slots = int(SLOTS)
        links = wp.zeros(shape=SLOTS, dtype=Link)
        C = wp.zeros(shape=SLOTS, dtype=vec6)
        A = wp.zeros(shape=SLOTS, dtype=vec6)
        U = wp.zeros(shape=SLOTS, dtype=vec6)
        loads = wp.zeros(shape=SLOTS, dtype=Load)
        dinv = wp.zeros(shape=SLOTS, dtype=T)
        u = wp.zeros(shape=SLOTS, dtype=T)
        motor = wp.zeros(shape=SLOTS, dtype=T)
        law = law_of(m, h, theta, start.factors, e)
        if wp.static(MUSCLE):
            pull = wp.zeros(shape=NU, dtype=T)
            muscle.activate(m, law, here, start.ctrl, pull)
        if wp.static(MOTOR):
            joint.drive(m, law, here, start.ctrl, motor)
        for i in range(1, n):
            links[i].q = read(start.qpos, e, qpos_adr(m, at + i))
            links[i].qd = read(start.qvel, e, VADR + link_of(m, at + i))
        if wp.static(NBALL > 0):
            turn = wp.zeros(shape=NBALL, dtype=quat)
            for b in range(m.ball_count[lane]):
                turn[b] = wp.normalize(kin.load_quat(start.qpos, e, qpos_adr(m, at + m.ball_slot[lane * NBALL + b])))
        links[0].R = wp.identity(3, dtype=T)
        if wp.static(FLOATING):
            pos = vec3(read(start.qpos, e, 0), read(start.qpos, e, 1), read(start.qpos, e, 2))
            rot = wp.normalize(kin.load_quat(start.qpos, e, 3))
            v = vec3(read(start.qvel, e, 0), read(start.qvel, e, 1), read(start.qvel, e, 2))
            w = vec3(read(start.qvel, e, 3), read(start.qvel, e, 4), read(start.qvel, e, 5))

        if wp.static(CONSTRAINED):
            free_loads = wp.zeros(shape=SLOTS, dtype=Load)  # without constraints
            B = wp.zeros(shape=SLOTS, dtype=vec6)  # the twist if the rates were the accelerations, see constraint.py
            guess = wp.zeros(shape=SLOTS, dtype=T)  # acceleration of the last pass, and that of the base
            if wp.static(SEARCH):
                lam = wp.zeros(shape=SLOTS, dtype=T)  # step of a pass
            residual = T(0.0)

        for sub in range(substeps):
            row = row0 + sub
            place = kin.carrier_place(m, T(0.0), T(0.0))
            if wp.static(FLOATING):
                links[0].R = wp.quat_to_matrix(rot)
                links[0].V = join(links[0].R * w, v)
                place = kin.carrier_place(m, pos[0], pos[2])
                if record == 1:
                    for k in range(3):
                        store(ck.q, row, k, e, pos[k])
                        store(ck.q, row, 4 + k, e, rot[k])
                        store(ck.v, row, k, e, v[k])
                        store(ck.v, row, 3 + k, e, w[k])
                    store(ck.q, row, 3, e, rot[3])
            # 1. outward: poses, velocities, velocity products, inertias and bias forces
            if wp.static(NBALL > 0):
                kin.place_balls(m, here, turn, links)
            place = kin.place_links(m, here, links, place)
            for i in range(1, n):
                k = at + i
                turning = i
                if wp.static(NBALL > 0):
                    turning = m.inboard[k]
                C[i] = wp.spatial_cross(links[turning].V, links[i].S * links[i].qd)
                if record == 1:
                    store(ck.q, row, qpos_adr(m, k), e, links[i].q)
                    store(ck.v, row, VADR + link_of(m, k), e, links[i].qd)
            if wp.static(NBALL > 0):
                for b in range(m.ball_count[lane]):
                    if record == 1:
                        adr = qpos_adr(m, at + m.ball_slot[lane * NBALL + b])
                        store(ck.q, row, adr, e, turn[b][3])
                        for k in range(3):
                            store(ck.q, row, adr + 1 + k, e, turn[b][k])
            for i in range(1, INERT + 1):
                loads[i] = Load()
            for i in range(FIRST, n):
                loads[i] = link.link_inertia(m, law, at + i, links[i], place)
            if wp.static(FORCED):
                force.add_forces(m, here, start.forces, links, loads)
            if wp.static(MUSCLE):
                muscle.add_muscles(m, here, pull, links, loads)
            # 2. inward: articulated inertias. With constraints each pass is a step of Newton's method, the first as if
            # all of them stuck. MuJoCo's implicit damping is one pass more: (M + h b) change = -h b a.
            begin = 0
            end = 1
            factor_row = row
            if wp.static(CONSTRAINED):
                end = passes + int(DAMPED)
                last_change = T(wp.inf)
                wdot = vec3()
                vdot = vec3()
                A[0] = join(vec3(), -vec3(m.gravity))
                if wp.static(FLOATING):
                    A[0] = A[0] - join(vec3(), wp.cross(links[0].R * w, v))
                B[0] = vec6()
                for i in range(n):
                    free_loads[i] = loads[i]
                    guess[i] = T(0.0)
                    if i > 0:
                        A[i] = A[m.parent[at + i]] + C[i]
                        B[i] = vec6()
            for solve in range(begin, end):
                if wp.static(CONSTRAINED):
                    newton = wp.where(solve < passes, 1, 0)
                    stuck = T(wp.where(solve == 0, 1, 0))
                    factor_row = SOLVES * row + (SOLVES - 1) * newton
                    for i in range(n):
                        loads[i] = free_loads[i]
                        if newton == 0:
                            loads[i].f = vec6()
                            C[i] = vec6()
                    if wp.static(CONTACT):
                        if newton == 1:
                            for i in range(FIRST, n):
                                k = at + i
                                loads[i] = constraint.add_contacts(
                                    m, law, k, links[i], A[i], B[i], place, stuck, loads[i]
                                )
                if wp.static(SHARERS > 1):
                    sums.sharers.add_loads(loads)
                for j in range(1, slots + 1):
                    i = slots - j
                    if wp.static(THREADS_PER_ENV > SHARERS):
                        if i == TRUNK:
                            sums.limbs.add_loads(loads)
                    if i > 0 and i < n:
                        k = at + i
                        p = m.parent[k]
                        sa = wp.spatial_top(links[i].S)
                        sl = wp.spatial_bottom(links[i].S)
                        own = loads[i]
                        Ua = own.a * sa + own.b * sl
                        Ul = sa * own.b + own.d * sl
                        Ui = join(Ua, Ul)
                        d = wp.dot(links[i].S, Ui) + T(m.armature[k])
                        qi = links[i].q
                        if wp.static(IMPLICIT):
                            qi = qi + theta * h * links[i].qd
                        free = T(1.0)
                        if wp.static(CLAMP):
                            free = joint.actuation_free(m, k, motor[i], qi, links[i].qd)
                        if wp.static(IMPLICIT):
                            resistance = joint.resistance(m, law, k, qi, links[i].qd, free)
                            d = d + theta * h * h * resistance[0] + h * resistance[1]
                        if wp.static(CONSTRAINED):
                            damper = h * joint.damping(m, k, free)
                            ui = -damper * guess[i]
                            if newton == 1:
                                held = constraint.joint_constraint(m, law, k, qi, links[i].qd, guess[i], stuck)
                                ui = joint.actuation(m, k, motor[i], qi, links[i].qd)
                                ui = ui + joint.passive_force(m, law, k, qi, links[i].qd) + held[0] + held[1] * guess[i]
                                d = d + held[1]
                            else:
                                d = d + damper
                            ui = ui - wp.dot(links[i].S, own.f)
                        else:
                            ui = joint.actuation(m, k, motor[i], qi, links[i].qd)
                            ui = ui + joint.passive_force(m, law, k, qi, links[i].qd) - wp.dot(links[i].S, own.f)
                        di = T(1.0) / d
                        if wp.static(FLOATING) or p > 0:
                            va = Ua * di
                            vl = Ul * di
                            ca = wp.spatial_top(C[i])
                            cl = wp.spatial_bottom(C[i])
                            bias = join(own.a * ca + own.b * cl, ca * own.b + own.d * cl)
                            loads[p].f = loads[p].f + own.f + bias + join(va, vl) * (ui - wp.dot(Ui, C[i]))
                            loads[p].a = loads[p].a + own.a - wp.outer(Ua, va)
                            loads[p].b = loads[p].b + own.b - wp.outer(Ua, vl)
                            loads[p].d = loads[p].d + own.d - wp.outer(Ul, vl)
                        U[i] = Ui
                        dinv[i] = di
                        u[i] = ui
                        if record == 1:
                            f0 = 7 * (link_of(m, k) - 1)
                            for r in range(6):
                                store(ck.f, factor_row, f0 + r, e, Ui[r])
                            store(ck.f, factor_row, f0 + 6, e, di)
                # 3. outward: accelerations (minus gravity, which acts as an acceleration of the base)
                A[0] = join(vec3(), -vec3(m.gravity))
                if wp.static(DAMPED):
                    A[0] = A[0] * T(newton)
                if wp.static(FLOATING):
                    L, a0 = base.factor_base(loads[0].a, loads[0].b, loads[0].d, -loads[0].f)
                    A[0] = a0
                    turning_up = wp.transpose(links[0].R) * wp.spatial_top(a0)
                    speeding_up = wp.spatial_bottom(a0) + wp.cross(wp.spatial_top(links[0].V), v) + vec3(m.gravity)
                    if record == 1:
                        base.store_base(ck.f, factor_row, e, L)
                for i in range(1, n):
                    ai = A[m.parent[at + i]] + C[i]
                    qdd = (u[i] - wp.dot(U[i], ai)) * dinv[i]
                    A[i] = ai + links[i].S * qdd
                    u[i] = qdd
                if wp.static(CONSTRAINED):
                    if newton == 1:
                        change = T(0.0)
                        size = T(1.0)
                        if wp.static(FLOATING):
                            change = wp.length_sq(turning_up - wdot) + wp.length_sq(speeding_up - vdot)
                            size = size + wp.length_sq(turning_up) + wp.length_sq(speeding_up)
                        for i in range(1, n):
                            change = change + (u[i] - guess[i]) * (u[i] - guess[i])
                            size = size + u[i] * u[i]
                        if wp.static(THREADS_PER_ENV > 1):
                            change = sums.add(change)
                            size = sums.add(size)
                        # Newton's method may go to and fro between zones, of dry friction above all.
                        if wp.static(SEARCH):
                            part = T(1.0)
                            if solve > 0:
                                U[0] = vec6()  # from here on twists of the step
                                if wp.static(FLOATING):
                                    U[0] = join(links[0].R * (turning_up - wdot), speeding_up - vdot)
                                for i in range(1, n):
                                    lam[i] = u[i] - guess[i]
                                    U[i] = U[m.parent[at + i]] + links[i].S * lam[i]
                                part = search(m, law, here, links, B, place, guess, lam, U, free_loads)
                        else:  # where a step is no shorter, half of it
                            part = pick(last_change, change, T(0.5), T(1.0))
                            last_change = change
                        if solve == passes - 1:
                            residual = wp.max(residual, wp.sqrt(change / size))
                        if record == 1 and solve == passes - 1:  # where the last step begins, of which the adjoint is
                            if wp.static(FLOATING):
                                for k in range(3):
                                    store(ck.a, row, NV + k, e, vdot[k])
                                    store(ck.a, row, NV + 3 + k, e, wdot[k])
                            for i in range(1, n):
                                store(ck.a, row, NV + VADR + link_of(m, at + i), e, guess[i])
                        if wp.static(FLOATING):
                            wdot = wdot + part * (turning_up - wdot)
                            vdot = vdot + part * (speeding_up - vdot)
                            turning_up = wdot
                            speeding_up = vdot
                            B[0] = join(links[0].R * wdot, vdot)
                            A[0] = join(links[0].R * wdot, vdot - wp.cross(links[0].R * w, v) - vec3(m.gravity))
                        for i in range(1, n):
                            p = m.parent[at + i]
                            guess[i] = guess[i] + part * (u[i] - guess[i])
                            u[i] = guess[i]
                            A[i] = A[p] + C[i] + links[i].S * guess[i]
                            B[i] = B[p] + links[i].S * guess[i]
                    else:
                        if wp.static(FLOATING):
                            turning_up = wdot + turning_up
                            speeding_up = vdot + wp.spatial_bottom(a0)
                        for i in range(1, n):
                            u[i] = guess[i] + u[i]
            # 4. the new state
            if wp.static(FLOATING):
                if record == 1:
                    for k in range(3):
                        store(ck.a, row, k, e, speeding_up[k])
                        store(ck.a, row, 3 + k, e, turning_up[k])
                v = v + h * speeding_up
                w = w + h * turning_up
                pos = pos + h * v
                rot = wp.normalize(rot * exp_quat(h * w))
            for i in range(1, n):
                links[i].qd = links[i].qd + h * u[i]
                links[i].q = links[i].q + h * links[i].qd
                if record == 1:
                    store(ck.a, row, VADR + link_of(m, at + i), e, u[i])
            if wp.static(NBALL > 0):
                for b in range(m.ball_count[lane]):
                    i = m.ball_slot[lane * NBALL + b]
                    turn[b] = wp.normalize(turn[b] * exp_quat(h * vec3(links[i].qd, links[i + 1].qd, links[i + 2].qd)))

        # An environment that left the finite numbers, or any imaginable speed, is handed back as it came.
        broken = T(0.0)
        if wp.static(FLOATING):
            for k in range(3):
                broken = broken + block.broken(pos[k]) + block.broken(rot[k]) + too_fast(v[k]) + too_fast(w[k])
            broken = broken + block.broken(rot[3])
        for i in range(1, n):
            broken = broken + block.broken(links[i].q) + too_fast(links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[lane]):
                for k in range(4):
                    broken = broken + block.broken(turn[b][k])
        if wp.static(THREADS_PER_ENV > 1):
            broken = sums.add(broken)
        block.write_flags(nonfinite, e, broken)
        if wp.static(CONSTRAINED):
            write(qvel_out, e, NV, pick(T(0.0), broken, T(0.0), residual))
        if wp.static(FLOATING):
            for k in range(3):
                hand_back(qpos_out, start.qpos, e, k, broken, pos[k])
                hand_back(qpos_out, start.qpos, e, 4 + k, broken, rot[k])
                hand_back(qvel_out, start.qvel, e, k, broken, v[k])
                hand_back(qvel_out, start.qvel, e, 3 + k, broken, w[k])
            hand_back(qpos_out, start.qpos, e, 3, broken, rot[3])
        for i in range(1, n):
            hand_back(qpos_out, start.qpos, e, qpos_adr(m, at + i), broken, links[i].q)
            hand_back(qvel_out, start.qvel, e, VADR + link_of(m, at + i), broken, links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[lane]):
                adr = qpos_adr(m, at + m.ball_slot[lane * NBALL + b])
                hand_back(qpos_out, start.qpos, e, adr, broken, turn[b][3])
                for k in range(3):
                    hand_back(qpos_out, start.qpos, e, adr + 1 + k, broken, turn[b][k])

    return forward

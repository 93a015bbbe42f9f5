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
from diffsim.kernels.newton import NEAR, PATIENCE, SEARCHES, newton_method
from diffsim.kernels.solve import base_inertia
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import MAX_SPEED, KernelSpec
from diffsim.kernels.wide import blocks, module_options

NEWTON, FACTOR, SOLVE, DONE = range(4)  # a substep's solves: Newton's passes, the factor at their end, and one more


@cache
def forward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec3, vec4, vec6, quat = t.T, t.vec3, t.vec4, t.vec6, t.quat
    Model, law_of = t.Model, environment_law(spec)
    join, exp_quat, store, link_of, qpos_adr = sp.join, sp.exp_quat, kin.store, kin.link_of, kin.qpos_adr
    read, write, pick = block.read, block.write, block.pick
    link, force, joint = link_law(spec), external_force(spec), joint_law(spec)
    muscle, base, constraint, newton = muscle_law(spec), base_inertia(spec), constraint_law(spec), newton_method(spec)
    CONTACT, MOTOR, CLAMP, MUSCLE = (name in spec.features for name in ("contact", "motor", "clamp", "muscle"))
    NU, FLOATING, IMPLICIT, FORCED = spec.nu, spec.floating, spec.implicit, spec.forced > 0
    # With MuJoCo's constraints a substep takes several solves.
    CONSTRAINED, SOLVES, DAMPED = spec.constrained, spec.solves, spec.damped
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    NV, VADR = spec.nv, spec.dof0 - 1  # link i's joint in qvel is VADR + i
    NBALL, LIMIT = spec.nball, MAX_SPEED
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.slots
    SPHERES, PATIENT = max(spec.spheres, 1), PATIENCE["frictionloss" in spec.features]

    Load, Link, Iterate, Touch = t.Load, t.Link, t.Iterate, t.Touch

    @wp.func
    def too_fast(rate: T):
        """1 where a rate is beyond any imaginable one, or no number, else 0."""
        return pick(wp.abs(rate), T(LIMIT), T(0.0), T(1.0))

    @wp.func
    def hand_back(out: t.array2, start: t.array2, e: int, column: int, broken: T, value: T):
        """Writes the value, but what it was at the start to broken environments."""
        write(out, e, column, pick(T(0.0), broken, read(start, e, column), value))

    @wp.kernel(module="unique", module_options=module_options(spec))
    def forward(
        # model
        m: Model,
        first: int,  # block of this launch
        seconds: t.U,  # of a substep
        implicitness: t.U,
        substeps: int,
        passes: int,  # of Newton's method at most, and what it converges to: read with constraints
        tolerance: t.U,
        start: t.Start,
        # checkpoint out: rows row0 .. row0 + substeps - 1, written if record is 1
        record: int,
        row0: int,
        ck: t.Checkpoint,
        # state out; with constraints the last columns of qvel_out are the residual and the number of passes
        qpos_out: t.array2,
        qvel_out: t.array2,
        nonfinite: wp.array(dtype=wp.bool),
        unconverged: wp.array(dtype=int),
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
            iterates = wp.zeros(shape=SLOTS, dtype=Iterate)
            touches = wp.zeros(shape=SPHERES, dtype=Touch)
            residual = T(0.0)
            count = T(0.0)

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
            # all of them stuck; the adjoint has the factor where it ends. MuJoCo's implicit damping is one solve more:
            # (M + h b) change = -h b a.
            phase = int(SOLVE)
            if wp.static(CONSTRAINED):
                phase = int(NEWTON)
                solve = int(0)  # passes so far
                going = T(1.0)  # 1 for environments that have not converged, else 0
                off = T(0.0)  # square of the residual
                size = T(1.0)  # 1 + the acceleration squared
                moved = T(0.0)  # the step squared
                wdot = vec3()
                vdot = vec3()
                turning_up = vec3()
                speeding_up = vec3()
                if wp.static(CONTACT):
                    constraint.touch(m, law, here, links, place, touches)
                for i in range(n):
                    free_loads[i] = loads[i]
                    iterates[i].rate = T(0.0)
                    iterates[i].twist = vec6()
                    if i > 0:
                        k = at + i
                        force_i = joint.actuation(m, k, motor[i], links[i].q, links[i].qd)
                        iterates[i].force = force_i + joint.passive_force(m, law, k, links[i].q, links[i].qd)
            while phase < DONE:
                if wp.static(CONSTRAINED):
                    if phase == NEWTON:
                        part = T(1.0)
                        bracket = vec4()
                        again = int(1)
                        while again > 0:  # until no step is too long
                            A[0] = join(vec3(), -vec3(m.gravity))
                            if wp.static(FLOATING):
                                A[0] = A[0] + join(links[0].R * wdot, vdot - wp.cross(links[0].R * w, v))
                                iterates[0].B = join(links[0].R * wdot, vdot)
                            found = newton.constrain(
                                m, law, here, links, C, touches, solve, dinv, iterates, free_loads, A, loads
                            )
                            if solve > 0:
                                off = pick(T(0.0), going, found[2] / size, off)
                            taken = part
                            if solve > 1 and again <= SEARCHES:
                                if again == 1:
                                    found[0] = pick(T(tolerance) * T(tolerance), off, going * found[0], T(0.0))
                                patience = T(wp.where(solve < PATIENT, 1.0, NEAR))
                                part, bracket = newton.search(
                                    m, here, iterates, free_loads, part, bracket, patience, found
                                )
                            again = again + 1
                            back = part / taken - T(1.0)
                            if block.any_of(wp.abs(back)):
                                for i in range(n):
                                    iterates[i].rate = iterates[i].rate + back * iterates[i].step
                                    iterates[i].step = iterates[i].step + back * iterates[i].step
                                    iterates[i].twist = iterates[i].twist + back * iterates[i].twist
                                if wp.static(FLOATING):
                                    wdot = wdot + back * turning_up
                                    vdot = vdot + back * speeding_up
                                    turning_up = turning_up + back * turning_up
                                    speeding_up = speeding_up + back * speeding_up
                            else:
                                again = 0
                        if solve > 0:
                            off = off + (T(1.0) - part) * (T(1.0) - part) * moved / size  # what was not taken
                            going = pick(T(tolerance) * T(tolerance), off, going, T(0.0))
                        if solve == passes or not block.any_of(going):
                            residual = wp.max(residual, off)
                            phase = DONE - int(DAMPED)
                            if record == 1:
                                phase = FACTOR
                        else:
                            count = count + going
                            solve = solve + 1
                if phase < DONE:
                    factor_row = SOLVES * row
                    if wp.static(DAMPED):
                        if phase == FACTOR:
                            factor_row = factor_row + 1
                        if phase == SOLVE:
                            for i in range(n):
                                loads[i] = free_loads[i]
                                loads[i].f = vec6()
                                C[i] = vec6()
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
                                if phase == SOLVE:
                                    damper = h * joint.damping(m, k, free)
                                    d = d + damper
                                    ui = -damper * iterates[i].rate - wp.dot(links[i].S, own.f)
                                else:
                                    d = d + iterates[i].firm
                                    ui = iterates[i].force + iterates[i].held + iterates[i].firm * iterates[i].rate
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
                            if record == 1 and phase > NEWTON:
                                f0 = 7 * (link_of(m, k) - 1)
                                for r in range(6):
                                    store(ck.f, factor_row, f0 + r, e, Ui[r])
                                store(ck.f, factor_row, f0 + 6, e, di)
                    # 3. outward: accelerations (minus gravity, which acts as an acceleration of the base)
                    A[0] = join(vec3(), -vec3(m.gravity))
                    if wp.static(DAMPED):
                        if phase == SOLVE:
                            A[0] = vec6()
                    if wp.static(FLOATING):
                        L, a0 = base.factor_base(loads[0].a, loads[0].b, loads[0].d, -loads[0].f)
                        A[0] = a0
                        turning_up = wp.transpose(links[0].R) * wp.spatial_top(a0)
                        speeding_up = wp.spatial_bottom(a0) + wp.cross(wp.spatial_top(links[0].V), v) + vec3(m.gravity)
                        if record == 1 and phase > NEWTON:
                            base.store_base(ck.f, factor_row, e, L)
                    for i in range(1, n):
                        ai = A[m.parent[at + i]] + C[i]
                        qdd = (u[i] - wp.dot(U[i], ai)) * dinv[i]
                        A[i] = ai + links[i].S * qdd
                        u[i] = qdd
                    if wp.static(CONSTRAINED):
                        if phase == NEWTON:
                            size = T(0.0)
                            moved = T(0.0)
                            if wp.static(FLOATING):
                                turning_up = newton.going_on(going, turning_up - wdot)
                                speeding_up = newton.going_on(going, speeding_up - vdot)
                                wdot = wdot + turning_up
                                vdot = vdot + speeding_up
                                iterates[0].twist = join(links[0].R * turning_up, speeding_up)
                                size = T(m.carried[at]) * (wp.length_sq(wdot) + wp.length_sq(vdot))
                                moved = wp.length_sq(turning_up) + wp.length_sq(speeding_up)
                                moved = T(m.carried[at]) * moved
                            for i in range(1, n):
                                step = pick(T(0.0), going, u[i] - iterates[i].rate, T(0.0))
                                rate = iterates[i].rate + step
                                iterates[i].step = step
                                iterates[i].rate = rate
                                iterates[i].twist = iterates[m.parent[at + i]].twist + links[i].S * step
                                size = size + T(m.carried[at + i]) * rate * rate
                                moved = moved + T(m.carried[at + i]) * step * step
                            if wp.static(THREADS_PER_ENV > 1):
                                size = sums.add(size)
                                moved = sums.add(moved)
                            size = size + T(1.0)
                        if phase == SOLVE:
                            for i in range(1, n):
                                u[i] = iterates[i].rate + u[i]
                            if wp.static(FLOATING):
                                turning_up = wdot + turning_up
                                speeding_up = vdot + wp.spatial_bottom(a0)
                    if phase > NEWTON:
                        phase = phase + 1
                        if wp.static(not DAMPED):
                            phase = DONE
            if wp.static(CONSTRAINED and not DAMPED):
                for i in range(1, n):
                    u[i] = iterates[i].rate
                if wp.static(FLOATING):
                    turning_up = wdot
                    speeding_up = vdot
            if wp.static(CONSTRAINED):
                if record == 1:  # the acceleration of the constraints, of which the adjoint is
                    if wp.static(FLOATING):
                        for k in range(3):
                            store(ck.a, row, NV + k, e, vdot[k])
                            store(ck.a, row, NV + 3 + k, e, wdot[k])
                    for i in range(1, n):
                        store(ck.a, row, NV + VADR + link_of(m, at + i), e, iterates[i].rate)
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
            residual = pick(T(0.0), broken, T(0.0), wp.sqrt(residual))
            write(qvel_out, e, NV, residual)
            write(qvel_out, e, NV + 1, count)
            if lane == 0:
                block.count(unconverged, e, pick(T(tolerance), residual, T(1.0), T(0.0)))
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

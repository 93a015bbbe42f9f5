"""The adjoint of one control step, written by hand: the solver is never differentiated.

A substep solves r(q, v, a, u) = M a + c - tau - J'f = 0, then v' = v + h a and q' = q (+) h v'. With g the adjoint that
reaches a, lambda = -M^-1 g by two sweeps with the stored factor, and W_i the twist of link i under lambda,

    phi = sum_i W_i . (I_i a_i + v_i x* I_i v_i - f_i) - lambda . tau

is a scalar whose partial derivatives in q, v and u are the answer. Per link, adj_a = I W, adj_w = its net force,
adj_v = I (W x v) - W x* I v + v x* I W + contacts, and adj_p is the wrench on its pose. Turning a subtree together with
all its motion leaves phi's inertial part unchanged, so after summing over subtrees only the parent's quantities enter:

    adj_q += adj_p.S - (adj_v - v_p x* adj_a).(S x v_p) - adj_w.(S x W_p) - adj_a.(S x a_p) - lambda dtau/dq
    adj_v += (adj_v - (v_p + v_i) x* adj_a).S - lambda dtau/dv
    adj_u -= lambda gear

The adjoint of a rotation lives in the body's tangent space; quaternions appear where gradients enter and leave.
"""

from functools import cache

import warp as wp

from diffsim.kernels.constraint import constraint_law
from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.factors import D_LIMIT, K_LIMIT, MOTOR, environment_law
from diffsim.kernels.force import external_force
from diffsim.kernels.joint import joint_law
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.link import link_law
from diffsim.kernels.model import types
from diffsim.kernels.muscle import muscle_law
from diffsim.kernels.solve import factor_solve
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks, module_options
from diffsim.robot.scene import FACTORS


@cache
def backward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec2, vec3, vec6, quat = t.T, t.vec2, t.vec3, t.vec6, t.quat
    Model, Link, law_of, solve_with_factor = t.Model, t.Link, environment_law(spec), factor_solve(spec)
    join, load, link_of, qpos_adr = sp.join, kin.load, kin.link_of, kin.qpos_adr
    link, force, joint = link_law(spec), external_force(spec), joint_law(spec)
    muscle, constraint = muscle_law(spec), constraint_law(spec)
    CONSTRAINED, SOLVES, DAMPED, NV = spec.constrained, spec.solves, spec.damped, spec.nv
    CONTACT, DRIVEN, CLAMP, MUSCLE, LIMIT = (
        name in spec.features for name in ("contact", "motor", "clamp", "muscle", "limit")
    )
    LIMIT = LIMIT and not spec.constrained  # the penalty law
    NU, FLOATING, IMPLICIT, VARIED, FORCED = spec.nu, spec.floating, spec.implicit, spec.varied, spec.forced > 0
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    read, write, pick = block.read, block.write, block.pick
    VADR, NBALL, BALL_SPRING = spec.dof0 - 1, spec.nball, spec.nball > 0 and "stiffness" in spec.features
    NFACTORS, NBODY = len(FACTORS), spec.forced
    SOME_FACTORS = NFACTORS if VARIED else 1  # nobody reads or writes it where none vary
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.slots

    @wp.func
    def next_rate(ck_v: t.array3, ck_a: t.array3, row: int, k: int, e: int, h: T):
        """Three rates in a row at the end of the substep."""
        v = vec3(load(ck_v, row, k, e), load(ck_v, row, k + 1, e), load(ck_v, row, k + 2, e))
        return v + h * vec3(load(ck_a, row, k, e), load(ck_a, row, k + 1, e), load(ck_a, row, k + 2, e))

    @wp.func
    def hand_out(out: t.array2, e: int, column: int, drop: T, value: T):
        """Writes the value, but 0 where the gradient is dropped."""
        write(out, e, column, pick(T(0.0), drop, T(0.0), value))

    @wp.kernel(module="unique", module_options=module_options(spec))
    def backward(
        # model
        m: Model,
        first: int,  # block of this launch
        seconds: t.U,  # of a substep
        implicitness: t.U,
        substeps: int,
        # checkpoint in
        row0: int,
        ck_q: t.array3,
        ck_v: t.array3,
        ck_a: t.array3,
        ck_f: t.array3,
        # the state that came in (its quaternion may not be of unit length), and whether the step was contained
        qpos: t.array2,
        ctrl: t.array2,
        factors: t.array2,
        forces: t.array2,
        nonfinite: wp.array(dtype=wp.bool),
        # gradient in
        g_qpos_out: t.array2,
        g_qvel_out: t.array2,
        # gradient out
        g_qpos: t.array2,
        g_qvel: t.array2,
        g_ctrl: t.array2,
        g_factors: t.array2,
        g_forces: t.array2,
        nonfinite_gradients: wp.array(dtype=int),
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
        A = wp.zeros(shape=SLOTS, dtype=vec6)
        W = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_a = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_v = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_w = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_p = wp.zeros(shape=SLOTS, dtype=vec6)
        gq = wp.zeros(shape=SLOTS, dtype=T)
        gqd = wp.zeros(shape=SLOTS, dtype=T)
        gtau = wp.zeros(shape=SLOTS, dtype=T)
        lam = wp.zeros(shape=SLOTS, dtype=T)
        u = wp.zeros(shape=SLOTS, dtype=T)
        law = law_of(m, h, theta, factors, e)
        if wp.static(CLAMP):
            driven = wp.zeros(shape=SLOTS, dtype=T)
            joint.drive(m, law, here, ctrl, driven)
            free = wp.zeros(shape=SLOTS, dtype=T)  # see joint.py
        adj_factors = wp.zeros(shape=SOME_FACTORS, dtype=T)
        if wp.static(FORCED):
            adj_forces = wp.zeros(shape=NBODY, dtype=vec6)
        for i in range(1, n):
            gq[i] = read(g_qpos_out, e, qpos_adr(m, at + i))
            gqd[i] = read(g_qvel_out, e, VADR + link_of(m, at + i))
        if wp.static(MUSCLE):
            pull = wp.zeros(shape=NU, dtype=T)
            adj_pull = wp.zeros(shape=NU, dtype=T)
            muscle.activate(m, law, here, ctrl, pull)
        if wp.static(CONSTRAINED):
            B = wp.zeros(shape=SLOTS, dtype=vec6)  # as in the forward kernel, and its adjoint
            adj_b = wp.zeros(shape=SLOTS, dtype=vec6)
            rate = wp.zeros(shape=SLOTS, dtype=T)  # the acceleration, before damping
        if wp.static(DAMPED):
            W1 = wp.zeros(shape=SLOTS, dtype=vec6)
            D = wp.zeros(shape=SLOTS, dtype=vec6)  # what damping adds to B
            ga = wp.zeros(shape=SLOTS, dtype=T)
            adj_d = wp.zeros(shape=SLOTS, dtype=vec6)
            adj_w1 = wp.zeros(shape=SLOTS, dtype=vec6)
        links[0].R = wp.identity(3, dtype=T)
        end = row0 + substeps - 1
        if wp.static(NBALL > 0):
            turn = wp.zeros(shape=NBALL, dtype=quat)
            for b in range(m.ball_count[lane]):
                i = m.ball_slot[lane * NBALL + b]
                adr = qpos_adr(m, at + i)
                wb = next_rate(ck_v, ck_a, end, VADR + link_of(m, at + i), e, h)
                rot_b = wp.normalize(kin.load_quat_row(ck_q, end, adr, e) * sp.exp_quat(h * wb))
                gb = sp.to_tangent(rot_b, kin.load_quat(g_qpos_out, e, adr))
                for k in range(3):
                    gq[i + k] = gb[k]
        if wp.static(FLOATING):
            w = next_rate(ck_v, ck_a, end, 3, e, h)
            rot = wp.normalize(kin.load_quat_row(ck_q, end, 3, e) * sp.exp_quat(h * w))
            gp = vec3(read(g_qpos_out, e, 0), read(g_qpos_out, e, 1), read(g_qpos_out, e, 2))
            gr = sp.to_tangent(rot, kin.load_quat(g_qpos_out, e, 3))
            gv = vec3(read(g_qvel_out, e, 0), read(g_qvel_out, e, 1), read(g_qvel_out, e, 2))
            gw = vec3(read(g_qvel_out, e, 3), read(g_qvel_out, e, 4), read(g_qvel_out, e, 5))

        for sub in range(substeps):
            row = row0 + substeps - 1 - sub
            # 1. the state of this substep, and the adjoint of the integrator
            place = kin.carrier_place(m, T(0.0), T(0.0))
            A[0] = join(vec3(), -vec3(m.gravity))
            for i in range(1, n):
                links[i].q = load(ck_q, row, qpos_adr(m, at + i), e)
                links[i].qd = load(ck_v, row, VADR + link_of(m, at + i), e)
                gqd[i] = gqd[i] + h * gq[i]
            if wp.static(NBALL > 0):
                for b in range(m.ball_count[lane]):
                    i = m.ball_slot[lane * NBALL + b]
                    turn[b] = kin.load_quat_row(ck_q, row, qpos_adr(m, at + i), e)
                    gb = vec3(gq[i], gq[i + 1], gq[i + 2])
                    gb_turn, gb_start = sp.exp_adjoint(
                        h * next_rate(ck_v, ck_a, row, VADR + link_of(m, at + i), e, h), gb
                    )
                    for k in range(3):
                        gqd[i + k] = gqd[i + k] + h * (gb_turn[k] - gb[k])
                        gq[i + k] = gb_start[k]
                kin.place_balls(m, here, turn, links)
            if wp.static(FLOATING):
                rot = kin.load_quat_row(ck_q, row, 3, e)
                v = vec3(load(ck_v, row, 0, e), load(ck_v, row, 1, e), load(ck_v, row, 2, e))
                w = vec3(load(ck_v, row, 3, e), load(ck_v, row, 4, e), load(ck_v, row, 5, e))
                vdot = vec3(load(ck_a, row, 0, e), load(ck_a, row, 1, e), load(ck_a, row, 2, e)) - vec3(m.gravity)
                wdot = vec3(load(ck_a, row, 3, e), load(ck_a, row, 4, e), load(ck_a, row, 5, e))
                g_turn, gr_start = sp.exp_adjoint(h * (w + h * wdot), gr)
                gv = gv + h * gp
                gw = gw + h * g_turn
                gr = gr_start
                place = kin.carrier_place(m, load(ck_q, row, 0, e), load(ck_q, row, 2, e))
                links[0].R = wp.quat_to_matrix(rot)
                links[0].V = join(links[0].R * w, v)
                if wp.static(DAMPED):
                    D[0] = join(links[0].R * wdot, vdot)
                if wp.static(CONSTRAINED):
                    vdot = vec3(load(ck_a, row, NV, e), load(ck_a, row, NV + 1, e), load(ck_a, row, NV + 2, e))
                    vdot = vdot - vec3(m.gravity)
                    wdot = vec3(load(ck_a, row, NV + 3, e), load(ck_a, row, NV + 4, e), load(ck_a, row, NV + 5, e))
                if wp.static(DAMPED):
                    D[0] = D[0] - join(links[0].R * wdot, vdot)
                A[0] = join(links[0].R * wdot, vdot - wp.cross(links[0].R * w, v))
                if wp.static(CONSTRAINED):
                    B[0] = join(links[0].R * wdot, vdot + vec3(m.gravity))
            place = kin.place_links(m, here, links, place)
            for i in range(1, n):
                k = at + i
                p = m.parent[k]
                links[i].V = links[p].V + links[i].S * links[i].qd
                turning = i
                if wp.static(NBALL > 0):
                    turning = m.inboard[k]
                qdd = load(ck_a, row, int(CONSTRAINED) * NV + VADR + link_of(m, k), e)
                A[i] = A[p] + links[i].S * qdd + wp.spatial_cross(links[turning].V, links[i].S * links[i].qd)
                if wp.static(CONSTRAINED):
                    rate[i] = qdd
                    B[i] = B[p] + links[i].S * qdd
                if wp.static(DAMPED):
                    D[i] = D[p] + links[i].S * (load(ck_a, row, VADR + link_of(m, k), e) - qdd)
                if wp.static(CLAMP):
                    ahead = links[i].q
                    if wp.static(IMPLICIT):
                        ahead = ahead + theta * h * links[i].qd
                    free[i] = joint.actuation_free(m, k, driven[i], ahead, links[i].qd)
            # 2. lambda = -M^-1 g. Where damping follows the constraints, W1 = J lambda1 of (M + h b) lambda1 = -g comes
            # first, and g + h b lambda1 reaches the acceleration before it.
            g_base = vec6()
            if wp.static(FLOATING):
                g_base = join(links[0].R * gw, gv)
            for solve in range(SOLVES):
                if wp.static(DAMPED):
                    for i in range(n):
                        W1[i] = W[i]
                        within = T(1.0)
                        if wp.static(CLAMP):
                            within = free[i]
                        ga[i] = gqd[i] + T(solve) * joint.damping(m, at + i, within) * lam[i]
                    solve_with_factor(m, here, ck_f, SOLVES * row + solve, links, h, g_base, ga, u, W, lam)
                else:
                    solve_with_factor(m, here, ck_f, row, links, h, g_base, gqd, u, W, lam)
            # 3. the partial derivatives of phi, link by link
            for i in range(1, INERT + 1):
                adj_a[i] = vec6()
                adj_v[i] = vec6()
                adj_w[i] = vec6()
                adj_p[i] = vec6()
                if wp.static(CONSTRAINED):
                    adj_b[i] = vec6()
                if wp.static(DAMPED):
                    adj_d[i] = vec6()
                    adj_w1[i] = vec6()
            for i in range(FIRST, n):
                la, lv, lw, lp = link.link_adjoint(m, law, at + i, links[i], A[i], W[i], place, adj_factors)
                if wp.static(CONSTRAINED and CONTACT):
                    lv, lw, lp, l_twist = constraint.add_contacts_adjoint(
                        m, law, at + i, links[i], B[i], W[i], place, lv, lw, lp, adj_factors
                    )
                    adj_b[i] = l_twist
                adj_a[i] = la
                adj_v[i] = lv
                adj_w[i] = lw
                adj_p[i] = lp
                if wp.static(DAMPED):
                    # phi has W1 . I D besides.
                    ld, lw1 = link.damping_adjoint(m, law, at + i, links[i], D[i], W1[i], adj_factors)
                    adj_d[i] = ld
                    adj_w1[i] = lw1
            if wp.static(FORCED):
                force.add_forces_adjoint(m, here, forces, links, W, adj_w, adj_p, adj_forces)
            if wp.static(MUSCLE):
                muscle.add_muscles_adjoint(m, here, pull, links, W, adj_w, adj_p, adj_pull)
            # 4. inward: sum over subtrees, project on the joints
            if wp.static(SHARERS > 1):
                sums.sharers.add_vectors(adj_a)
                sums.sharers.add_vectors(adj_v)
                sums.sharers.add_vectors(adj_w)
                sums.sharers.add_vectors(adj_p)
                if wp.static(CONSTRAINED):
                    sums.sharers.add_vectors(adj_b)
                if wp.static(DAMPED):
                    sums.sharers.add_vectors(adj_d)
                    sums.sharers.add_vectors(adj_w1)
            for j in range(1, slots + 1):
                i = slots - j
                if wp.static(THREADS_PER_ENV > SHARERS):
                    if i == TRUNK:
                        sums.limbs.add_vectors(adj_a)
                        sums.limbs.add_vectors(adj_v)
                        sums.limbs.add_vectors(adj_w)
                        sums.limbs.add_vectors(adj_p)
                        if wp.static(CONSTRAINED):
                            sums.limbs.add_vectors(adj_b)
                        if wp.static(DAMPED):
                            sums.limbs.add_vectors(adj_d)
                            sums.limbs.add_vectors(adj_w1)
                if i > 0 and i < n:
                    k = at + i
                    p = m.parent[k]
                    turned = i
                    if wp.static(NBALL > 0):
                        p = m.inboard[k]
                        turned = m.outboard[k]
                    qi = links[i].q
                    end_rate = links[i].qd
                    if wp.static(IMPLICIT):
                        qi = qi + theta * h * links[i].qd
                        if wp.static(LIMIT):
                            end_rate = end_rate + h * load(ck_a, row, VADR + link_of(m, k), e)
                    within = T(1.0)
                    if wp.static(CLAMP):
                        within = free[i]
                    gain = joint.gain(m, law, k, qi, links[i].qd, end_rate, within)
                    if wp.static(VARIED and LIMIT):
                        if m.carried[k] == 1:  # of the lanes that have the joint
                            by = joint.limit_constants_gain(m, law, k, qi, links[i].qd, end_rate, theta * h)
                            adj_factors[K_LIMIT] = adj_factors[K_LIMIT] - lam[i] * by[0]
                            adj_factors[D_LIMIT] = adj_factors[D_LIMIT] - lam[i] * by[1]
                    if wp.static(CONSTRAINED):
                        of_held = constraint.joint_gain(m, law, k, links[i].q, links[i].qd, rate[i])
                        gain = gain + vec2(of_held[0], of_held[1])
                        if wp.static(VARIED):
                            if m.carried[k] == 1:  # of the lanes that have the joint
                                adj_factors[K_LIMIT] = adj_factors[K_LIMIT] - lam[i] * of_held[2]
                    kv = gain[1]
                    if wp.static(IMPLICIT):
                        kv = kv + theta * h * gain[0]
                    xv = adj_v[i] - wp.spatial_cross_dual(links[p].V, adj_a[i])
                    gq[i] = (
                        gq[i]
                        + wp.dot(adj_p[i], links[i].S)
                        - wp.dot(xv, wp.spatial_cross(links[i].S, links[p].V))
                        - wp.dot(adj_w[i], wp.spatial_cross(links[i].S, W[p]))
                        - wp.dot(adj_a[i], wp.spatial_cross(links[i].S, A[p]))
                        - lam[i] * gain[0]
                    )
                    if wp.static(CONSTRAINED):
                        gq[i] = gq[i] - wp.dot(adj_b[i], wp.spatial_cross(links[i].S, B[p]))
                    if wp.static(DAMPED):
                        gq[i] = gq[i] - wp.dot(adj_d[i], wp.spatial_cross(links[i].S, D[p]))
                        gq[i] = gq[i] - wp.dot(adj_w1[i], wp.spatial_cross(links[i].S, W1[p]))
                    gqd[i] = (
                        gqd[i] + wp.dot(xv - wp.spatial_cross_dual(links[turned].V, adj_a[i]), links[i].S) - lam[i] * kv
                    )
                    gtau[i] = gtau[i] - within * lam[i]
                    if wp.static(NBALL > 0):
                        p = m.parent[k]
                    if wp.static(FLOATING) or p > 0:
                        adj_a[p] = adj_a[p] + adj_a[i]
                        adj_v[p] = adj_v[p] + adj_v[i]
                        adj_w[p] = adj_w[p] + adj_w[i]
                        adj_p[p] = adj_p[p] + adj_p[i]
                        if wp.static(CONSTRAINED):
                            adj_b[p] = adj_b[p] + adj_b[i]
                        if wp.static(DAMPED):
                            adj_d[p] = adj_d[p] + adj_d[i]
                            adj_w1[p] = adj_w1[p] + adj_w1[i]
            if wp.static(BALL_SPRING):
                # The spring sees the rotation vector, whose derivative in the tangent space is not the identity.
                for b in range(m.ball_count[lane]):
                    i = m.ball_slot[lane * NBALL + b]
                    lb = vec3(lam[i], lam[i + 1], lam[i + 2])
                    lb = T(m.stiffness[at + i]) * (
                        sp.log_adjoint(vec3(links[i].q, links[i + 1].q, links[i + 2].q), lb) - lb
                    )
                    for k in range(3):
                        gq[i + k] = gq[i + k] + lb[k]
            if wp.static(FLOATING):
                # The floating base is a translation, whose "parent" twists are pure linear ones, then a ball joint.
                vp = join(vec3(), v)
                wl = join(vec3(), wp.spatial_bottom(W[0]))
                ap = join(vec3(), vdot)
                xv = adj_v[0] - wp.spatial_cross_dual(vp, adj_a[0])
                tq = adj_p[0] - wp.spatial_cross_dual(vp, xv)
                tq = tq - wp.spatial_cross_dual(wl, adj_w[0]) - wp.spatial_cross_dual(ap, adj_a[0])
                if wp.static(CONSTRAINED):
                    tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(B[0])), adj_b[0])
                if wp.static(DAMPED):
                    tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(D[0])), adj_d[0])
                    tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(W1[0])), adj_w1[0])
                tw = xv - wp.spatial_cross_dual(links[0].V, adj_a[0])
                gp = gp + wp.spatial_bottom(adj_p[0])
                gr = gr + wp.transpose(links[0].R) * wp.spatial_top(tq)
                gv = gv + wp.spatial_bottom(xv)
                gw = gw + wp.transpose(links[0].R) * wp.spatial_top(tw)

        # A gradient that left the finite numbers, or of a contained step, is zero.
        broken = T(0.0)
        for i in range(1, n):
            broken = broken + block.broken(gq[i]) + block.broken(gqd[i]) + block.broken(gtau[i])
        if wp.static(FLOATING):
            for k in range(3):
                broken = broken + block.broken(gp[k]) + block.broken(gr[k]) + block.broken(gv[k]) + block.broken(gw[k])
        if wp.static(MUSCLE):
            for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                broken = broken + block.broken(adj_pull[m.muscle[entry]])
        if wp.static(VARIED):
            for k in range(NFACTORS):
                broken = broken + block.broken(adj_factors[k])
        if wp.static(FORCED):
            broken = broken + force.broken_forces(m, here, adj_forces)
        if wp.static(THREADS_PER_ENV > 1):
            broken = sums.add(broken)
        contained = block.read_flags(nonfinite, e)
        if lane == 0:
            block.count(nonfinite_gradients, e, pick(T(0.0), contained, T(0.0), broken))
        drop = broken + contained
        for k in range(NU):
            if m.motor_lane[k] == lane:
                g = T(0.0)
                if wp.static(DRIVEN):
                    g = gtau[m.motor_slot[lane * NU + k]]
                if wp.static(MUSCLE):
                    g = g + adj_pull[k]
                if wp.static(VARIED):
                    motor = T(m.gear[k]) * read(ctrl, e, k) + T(m.motor_bias[k])
                    adj_factors[MOTOR] = adj_factors[MOTOR] + g * motor
                    g = law.motor * g
                hand_out(g_ctrl, e, k, drop, g * T(m.gear[k]))
        if wp.static(VARIED):
            for k in range(NFACTORS):
                total = adj_factors[k]
                if wp.static(THREADS_PER_ENV > 1):
                    total = sums.add(total)
                if lane == 0:
                    hand_out(g_factors, e, k, drop, total)
        if wp.static(FORCED):
            force.write_forces_adjoint(m, here, drop, adj_forces, g_forces)
        for i in range(1, n):
            hand_out(g_qpos, e, qpos_adr(m, at + i), drop, gq[i])
            hand_out(g_qvel, e, VADR + link_of(m, at + i), drop, gqd[i])
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[lane]):
                i = m.ball_slot[lane * NBALL + b]
                adr = qpos_adr(m, at + i)
                gb4 = sp.from_tangent(kin.load_quat(qpos, e, adr), vec3(gq[i], gq[i + 1], gq[i + 2]))
                hand_out(g_qpos, e, adr, drop, gb4[3])
                for k in range(3):
                    hand_out(g_qpos, e, adr + 1 + k, drop, gb4[k])
        if wp.static(FLOATING):
            g4 = sp.from_tangent(kin.load_quat(qpos, e, 3), gr)
            for k in range(3):
                hand_out(g_qpos, e, k, drop, gp[k])
                hand_out(g_qpos, e, 4 + k, drop, g4[k])
                hand_out(g_qvel, e, k, drop, gv[k])
                hand_out(g_qvel, e, 3 + k, drop, gw[k])
            hand_out(g_qpos, e, 3, drop, g4[3])

    return backward

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
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.contact import contact_law
from diffsim.kernels.drag import drag_law
from diffsim.kernels.force import external_force
from diffsim.kernels.hill import hill_law
from diffsim.kernels.joint import joint_law
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.lanes import lane_sums
from diffsim.kernels.law import D_LIMIT, K_D, K_LIMIT, K_N, K_T, MASS, MOTOR, MU, environment_law
from diffsim.kernels.model import types
from diffsim.kernels.muscle import muscle_law
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec, module_options
from diffsim.kernels.terrain import terrain_contact
from diffsim.robot.scene import FACTORS


@cache
def backward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin = types(spec.dtype), spatial(spec.dtype), kinematics(spec)
    T, vec2, vec3, vec6, mat3, quat = spec.dtype, t.vec2, t.vec3, t.vec6, t.mat3, t.quat
    Model, Law, Place = t.Model, t.Law, kin.Place
    vec6s, array = wp.array(dtype=vec6), t.array
    join, force_at, point_velocity, momentum = sp.join, sp.force_at, sp.point_velocity, sp.momentum
    exp_quat, exp_adjoint, log_adjoint = sp.exp_quat, sp.exp_adjoint, sp.log_adjoint
    to_tangent, from_tangent = sp.to_tangent, sp.from_tangent
    load, link_of, place_links, sphere_state = kin.load, kin.link_of, kin.place_links, kin.sphere_state
    qpos_adr, load_quat, load_quat_row, place_balls = kin.qpos_adr, kin.load_quat, kin.load_quat_row, kin.place_balls
    contact = contact_law(T)
    touches, contact_force = contact.touches, contact.contact_force
    contact_resistance, contact_adjoint = contact.contact_resistance, contact.contact_adjoint
    contact_constants_adjoint = contact.contact_constants_adjoint
    muscle = muscle_law(spec, adjoint=True)
    measure, add_pull_adjoint, hill = muscle.measure, muscle.add_pull_adjoint, hill_law(T).hill
    uses = spec.features
    sphere_on_terrain, TERRAIN = terrain_contact(spec), "terrain" in uses
    joint, law_of, VARIED = joint_law(spec), environment_law(spec), spec.varied
    passive_gain, limit_constants_gain = joint.passive_gain, joint.limit_constants_gain
    DRAG, drag = "drag" in uses, drag_law(T)
    drag_wrench, drag_adjoint = drag.drag_wrench, drag.drag_adjoint
    force, FORCED, NBODY = external_force(spec), spec.forced > 0, spec.forced
    add_forces_adjoint, write_forces_adjoint = force.add_forces_adjoint, force.write_forces_adjoint
    finite_forces = force.finite_forces
    NU, FLOATING, CONTACT, IMPLICIT = spec.nu, spec.floating, "contact" in uses, spec.implicit
    DRIVEN, MUSCLE, HILL, LIMIT = "motor" in uses, "muscle" in uses, "hill" in uses, "limit" in uses
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    VADR, NBALL, BALL_SPRING = spec.dof0 - 1, spec.nball, spec.nball > 0 and "stiffness" in uses
    NFACTORS = len(FACTORS)
    BASE = 7 * (spec.nlink - 1)  # where the base's factor begins
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.slots
    sums = lane_sums(T, THREADS_PER_ENV, SHARERS)

    @wp.func
    def solve_base(ck_f: t.array3, row: int, e: int, b: vec6):
        """I^-1 b with the base's stored Cholesky factor."""
        a = b
        for r in range(6):
            y = a[r]
            for k in range(r):
                y = y - load(ck_f, row, BASE + r * (r + 1) / 2 + k, e) * a[k]
            a[r] = y * load(ck_f, row, BASE + r * (r + 1) / 2 + r, e)
        for rr in range(6):
            r = 5 - rr
            y = a[r]
            for k in range(r + 1, 6):
                y = y - load(ck_f, row, BASE + k * (k + 1) / 2 + r, e) * a[k]
            a[r] = y * load(ck_f, row, BASE + r * (r + 1) / 2 + r, e)
        return a

    @wp.func
    def next_rate(ck_v: t.array3, ck_a: t.array3, row: int, k: int, e: int, h: T):
        """Three rates in a row at the end of the substep."""
        v = vec3(load(ck_v, row, k, e), load(ck_v, row, k + 1, e), load(ck_v, row, k + 2, e))
        return v + h * vec3(load(ck_a, row, k, e), load(ck_a, row, k + 1, e), load(ck_a, row, k + 2, e))

    @wp.func
    def link_adjoint(
        m: Model,
        law: Law,
        k: int,
        R: mat3,
        x: vec3,
        V: vec6,
        A: vec6,
        W: vec6,
        place: Place,
        h: T,
        theta: T,
        g_factors: array,  # written if varied only
    ):
        """(adj_a, adj_v, adj_w, adj_p) of one link's part of phi, all about the carrier's position."""
        com = x + R * m.com[k]
        inertia = R * m.inertia[k] * wp.transpose(R)
        Iv = momentum(m.mass[k], com, inertia, V)
        adj_a = momentum(m.mass[k], com, inertia, W)
        adj_w = momentum(m.mass[k], com, inertia, A) + wp.spatial_cross_dual(V, Iv)
        adj_v = momentum(m.mass[k], com, inertia, wp.spatial_cross(W, V))
        adj_v = adj_v - wp.spatial_cross_dual(W, Iv) + wp.spatial_cross_dual(V, adj_a)
        adj_p = vec6()
        if wp.static(VARIED):
            # phi's inertial part is W . adj_w, and all of this is that of a factor of one.
            g_factors[MASS] = g_factors[MASS] + wp.dot(W, adj_w)
            adj_a = law.mass * adj_a
            adj_w = law.mass * adj_w
            adj_v = law.mass * adj_v
        if wp.static(DRAG):
            adj_w = adj_w - drag_wrench(m, k, R, com, V)
            adj_v = adj_v + drag_adjoint(m, k, R, com, V, W)
        if wp.static(CONTACT):
            for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
                if wp.static(TERRAIN):
                    p, v, depth, E, curvature = sphere_on_terrain(m, law.profile, c, R, x, V, place, h, theta)
                else:
                    p, v, depth = sphere_state(m, c, R, x, V, place, h, theta)
                if touches(law, depth, v):
                    fc = contact_force(law, depth, v)
                    f = vec3(fc[0], fc[1], fc[2])
                    g_f = -point_velocity(W, p)
                    if wp.static(TERRAIN):  # the law and its adjoint act in the frame E
                        g_f = wp.transpose(E) * g_f
                    a = vec3()
                    hi = T(0.0)
                    if wp.static(IMPLICIT):
                        hi = h
                        a = point_velocity(A, p) + m.gravity
                        if wp.static(TERRAIN):
                            a = wp.transpose(E) * a
                        B = contact_resistance(law, depth, fc[3], h, theta)
                        f = f - wp.cw_mul(B, a)
                    g = contact_adjoint(law, depth, v, a, g_f, hi, theta)
                    if wp.static(VARIED):
                        gk = contact_constants_adjoint(law, depth, v, a, g_f, hi, theta)
                        g_factors[K_N] = g_factors[K_N] + m.k_n * gk[0]
                        g_factors[K_D] = g_factors[K_D] + m.k_d * gk[1]
                        g_factors[K_T] = g_factors[K_T] + m.k_t * gk[2]
                        g_factors[MU] = g_factors[MU] + m.mu * gk[3]
                    g_v = vec3(g[0], g[1], g[2])
                    if wp.static(TERRAIN):
                        g_turn = wp.cross(g_v, v)[1] - wp.cross(g_f, f)[1]  # adjoint of the angle of E
                        f = E * f
                        g_v = E * g_v
                    wrench = force_at(p, f)
                    G = force_at(p, g_v)
                    g_p = vec3(T(0.0), T(0.0), g[3])
                    if wp.static(TERRAIN):
                        g_p = E * g_p
                    g_p = g_p + wp.cross(g_v, wp.spatial_top(V)) - wp.cross(f, wp.spatial_top(W))
                    if wp.static(IMPLICIT):
                        g_a = -wp.cw_mul(B, g_f)
                        if wp.static(TERRAIN):
                            g_turn = g_turn + wp.cross(g_a, a)[1]
                            g_a = E * g_a
                        GA = force_at(p, g_a)
                        g_p = g_p + wp.cross(g_a, wp.spatial_top(A))
                        adj_a = adj_a + GA
                        adj_v = adj_v + wp.spatial_cross_dual(V, GA)
                        adj_p = adj_p + wp.spatial_cross_dual(A, GA)
                    adj_w = adj_w - wrench
                    adj_v = adj_v + G
                    # The lowest point follows the sphere's centre, not the body's material.
                    if wp.static(TERRAIN):
                        radius = m.contact_radius[c]
                        tangent = E * vec3(T(1.0), T(0.0), T(0.0))
                        centre = p + radius * E * vec3(T(0.0), T(0.0), T(1.0))
                        g_p = g_p + curvature * (g_turn - radius * wp.dot(tangent, g_p)) * tangent
                    else:
                        centre = p + vec3(T(0.0), T(0.0), m.contact_radius[c])
                    adj_p = adj_p + force_at(centre, g_p)
                    adj_p = adj_p + wp.spatial_cross_dual(V, G) - wp.spatial_cross_dual(W, wrench)
        return adj_a, adj_v, adj_w, adj_p

    def summed(over: SimpleNamespace, last: int) -> wp.Function:
        add_vec6 = over.add_vec6

        @wp.func
        def add_up(a: vec6s):
            begin = int(0)
            for i in range(begin, last + 1):
                a[i] = add_vec6(a[i])

        return add_up

    add_sharers, add_limbs, add = summed(sums.sharers, SLOTS - 1), summed(sums.limbs, TRUNK), sums.all.add

    @wp.kernel(module="unique", module_options=module_options(spec))
    def backward(
        # model
        m: Model,
        first: int,  # environment of this launch
        h: T,
        theta: T,
        substeps: int,
        # checkpoint in
        row0: int,
        ck_q: t.array3,
        ck_v: t.array3,
        ck_a: t.array3,
        ck_f: t.array3,
        # the state that came in (its quaternion may not be of unit length), and whether the step was contained
        qpos: t.array2,
        ctrl: t.array2,  # and behind it the factors and the forces; so in g_ctrl
        nonfinite: wp.array(dtype=wp.bool),
        # gradient in
        g_qpos_out: t.array2,
        g_qvel_out: t.array2,
        # gradient out
        g_qpos: t.array2,
        g_qvel: t.array2,
        g_ctrl: t.array2,
        nonfinite_gradients: wp.array(dtype=int),
    ):
        tid = wp.tid()
        e = first + tid / THREADS_PER_ENV
        lane = tid % THREADS_PER_ENV
        slots = int(SLOTS)
        n = int(SLOTS)
        at = lane * SLOTS
        if wp.static(THREADS_PER_ENV > 1):
            n = m.count[lane]
        R = wp.zeros(shape=SLOTS, dtype=mat3)
        x = wp.zeros(shape=SLOTS, dtype=vec3)
        S = wp.zeros(shape=SLOTS, dtype=vec6)
        V = wp.zeros(shape=SLOTS, dtype=vec6)
        A = wp.zeros(shape=SLOTS, dtype=vec6)
        W = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_a = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_v = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_w = wp.zeros(shape=SLOTS, dtype=vec6)
        adj_p = wp.zeros(shape=SLOTS, dtype=vec6)
        q = wp.zeros(shape=SLOTS, dtype=T)
        qd = wp.zeros(shape=SLOTS, dtype=T)
        gq = wp.zeros(shape=SLOTS, dtype=T)
        gqd = wp.zeros(shape=SLOTS, dtype=T)
        gtau = wp.zeros(shape=SLOTS, dtype=T)
        lam = wp.zeros(shape=SLOTS, dtype=T)
        u = wp.zeros(shape=SLOTS, dtype=T)
        law = law_of(m, ctrl, e)
        if wp.static(VARIED):
            g_factors = wp.zeros(shape=NFACTORS, dtype=T)
        else:
            g_factors = u  # nobody reads or writes it there
        if wp.static(FORCED):
            g_forces = wp.zeros(shape=NBODY, dtype=vec6)
        for i in range(1, n):
            gq[i] = g_qpos_out[e, qpos_adr(m, at + i)]
            gqd[i] = g_qvel_out[e, VADR + link_of(m, at + i)]
        if wp.static(MUSCLE):
            pull = wp.zeros(shape=NU, dtype=T)
            g_pull = wp.zeros(shape=NU, dtype=T)
            for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                k = m.muscle[entry]
                pull[k] = m.gear[k] * ctrl[e, k] + m.motor_bias[k]
                if wp.static(VARIED):
                    pull[k] = law.motor * pull[k]
            tension = pull
            by_length = pull
            by_rate = pull
        if wp.static(HILL):
            tension = wp.zeros(shape=NU, dtype=T)
            by_length = wp.zeros(shape=NU, dtype=T)
            by_rate = wp.zeros(shape=NU, dtype=T)
            power = wp.zeros(shape=NU, dtype=T)
            path = wp.zeros(shape=NU, dtype=T)
        R[0] = wp.identity(3, dtype=T)
        end = row0 + substeps - 1
        if wp.static(NBALL > 0):
            turn = wp.zeros(shape=NBALL, dtype=quat)
            for b in range(m.ball_count[lane]):
                i = m.ball_slot[lane * NBALL + b]
                adr = qpos_adr(m, at + i)
                wb = next_rate(ck_v, ck_a, end, VADR + link_of(m, at + i), e, h)
                rot_b = wp.normalize(load_quat_row(ck_q, end, adr, e) * exp_quat(h * wb))
                gb = to_tangent(rot_b, load_quat(g_qpos_out, e, adr))
                for k in range(3):
                    gq[i + k] = gb[k]
        if wp.static(FLOATING):
            w = next_rate(ck_v, ck_a, end, 3, e, h)
            rot = wp.normalize(load_quat_row(ck_q, end, 3, e) * exp_quat(h * w))
            gp = vec3(g_qpos_out[e, 0], g_qpos_out[e, 1], g_qpos_out[e, 2])
            gr = to_tangent(rot, load_quat(g_qpos_out, e, 3))
            gv = vec3(g_qvel_out[e, 0], g_qvel_out[e, 1], g_qvel_out[e, 2])
            gw = vec3(g_qvel_out[e, 3], g_qvel_out[e, 4], g_qvel_out[e, 5])

        for sub in range(substeps):
            row = row0 + substeps - 1 - sub
            # 1. the state of this substep, and the adjoint of the integrator
            if wp.static(TERRAIN):
                place = vec2(m.carrier_along, m.carrier_height)
            else:
                place = m.carrier_height
            A[0] = join(vec3(), -m.gravity)
            for i in range(1, n):
                q[i] = load(ck_q, row, qpos_adr(m, at + i), e)
                qd[i] = load(ck_v, row, VADR + link_of(m, at + i), e)
                gqd[i] = gqd[i] + h * gq[i]
            if wp.static(NBALL > 0):
                for b in range(m.ball_count[lane]):
                    i = m.ball_slot[lane * NBALL + b]
                    turn[b] = load_quat_row(ck_q, row, qpos_adr(m, at + i), e)
                    gb = vec3(gq[i], gq[i + 1], gq[i + 2])
                    gb_turn, gb_start = exp_adjoint(h * next_rate(ck_v, ck_a, row, VADR + link_of(m, at + i), e, h), gb)
                    for k in range(3):
                        gqd[i + k] = gqd[i + k] + h * (gb_turn[k] - gb[k])
                        gq[i + k] = gb_start[k]
                place_balls(m, lane, turn, R, q)
            if wp.static(FLOATING):
                rot = load_quat_row(ck_q, row, 3, e)
                v = vec3(load(ck_v, row, 0, e), load(ck_v, row, 1, e), load(ck_v, row, 2, e))
                w = vec3(load(ck_v, row, 3, e), load(ck_v, row, 4, e), load(ck_v, row, 5, e))
                vdot = vec3(load(ck_a, row, 0, e), load(ck_a, row, 1, e), load(ck_a, row, 2, e)) - m.gravity
                wdot = vec3(load(ck_a, row, 3, e), load(ck_a, row, 4, e), load(ck_a, row, 5, e))
                g_turn, gr_start = exp_adjoint(h * (w + h * wdot), gr)
                gv = gv + h * gp
                gw = gw + h * g_turn
                gr = gr_start
                if wp.static(TERRAIN):
                    place = place + vec2(load(ck_q, row, 0, e), load(ck_q, row, 2, e))
                else:
                    place = place + load(ck_q, row, 2, e)
                R[0] = wp.quat_to_matrix(rot)
                V[0] = join(R[0] * w, v)
                A[0] = join(R[0] * wdot, vdot - wp.cross(R[0] * w, v))
            place = place_links(m, at, n, q, R, x, S, place)
            for i in range(1, n):
                k = at + i
                p = m.parent[k]
                V[i] = V[p] + S[i] * qd[i]
                turning = i
                if wp.static(NBALL > 0):
                    turning = m.inboard[k]
                qdd = load(ck_a, row, VADR + link_of(m, k), e)
                A[i] = A[p] + S[i] * qdd + wp.spatial_cross(V[turning], S[i] * qd[i])
                W[i] = vec6()
            # 2. lambda = -M^-1 g; on the way in, W holds the articulated bias force
            W[0] = vec6()
            for j in range(1, slots + 1):
                i = slots - j
                if wp.static(THREADS_PER_ENV > SHARERS):
                    if i == TRUNK:
                        add_limbs(W)
                if i > 0 and i < n:
                    p = m.parent[at + i]
                    ui = -h * gqd[i] - wp.dot(S[i], W[i])
                    u[i] = ui
                    if wp.static(FLOATING) or p > 0:
                        f0 = 7 * (link_of(m, at + i) - 1)
                        Ui = vec6()
                        for r in range(6):
                            Ui[r] = load(ck_f, row, f0 + r, e)
                        W[p] = W[p] + W[i] + Ui * (ui * load(ck_f, row, f0 + 6, e))
            if wp.static(FLOATING):
                W[0] = solve_base(ck_f, row, e, join(R[0] * gw, gv) * (-h) - W[0])
            for i in range(1, n):
                p = m.parent[at + i]
                f0 = 7 * (link_of(m, at + i) - 1)
                UW = T(0.0)
                for r in range(6):
                    UW = UW + load(ck_f, row, f0 + r, e) * W[p][r]
                lam[i] = (u[i] - UW) * load(ck_f, row, f0 + 6, e)
                W[i] = W[p] + S[i] * lam[i]
            # 3. the partial derivatives of phi, link by link
            for i in range(1, INERT + 1):
                adj_a[i] = vec6()
                adj_v[i] = vec6()
                adj_w[i] = vec6()
                adj_p[i] = vec6()
            for i in range(FIRST, n):
                la, lv, lw, lp = link_adjoint(m, law, at + i, R[i], x[i], V[i], A[i], W[i], place, h, theta, g_factors)
                adj_a[i] = la
                adj_v[i] = lv
                adj_w[i] = lw
                adj_p[i] = lp
            if wp.static(FORCED):
                add_forces_adjoint(m, at, n, ctrl, e, R, x, W, adj_w, adj_p, g_forces)
            if wp.static(HILL):
                measure(m, lane, R, x, V, W, path, by_rate, power)
                for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                    k = m.muscle[entry]
                    curve = hill(m, k, pull[k], path[k], by_rate[k])
                    tension[k] = curve[0]
                    g_pull[k] = g_pull[k] + power[k] * curve[1]
                    by_length[k] = power[k] * curve[2]
                    by_rate[k] = power[k] * curve[3]
            if wp.static(MUSCLE):
                add_pull_adjoint(m, lane, tension, by_length, by_rate, R, x, V, W, adj_v, adj_w, adj_p, g_pull)
            # 4. inward: sum over subtrees, project on the joints
            if wp.static(SHARERS > 1):
                add_sharers(adj_a)
                add_sharers(adj_v)
                add_sharers(adj_w)
                add_sharers(adj_p)
            for j in range(1, slots + 1):
                i = slots - j
                if wp.static(THREADS_PER_ENV > SHARERS):
                    if i == TRUNK:
                        add_limbs(adj_a)
                        add_limbs(adj_v)
                        add_limbs(adj_w)
                        add_limbs(adj_p)
                if i > 0 and i < n:
                    k = at + i
                    p = m.parent[k]
                    turned = i
                    if wp.static(NBALL > 0):
                        p = m.inboard[k]
                        turned = m.outboard[k]
                    qi = q[i]
                    end_rate = qd[i]
                    if wp.static(IMPLICIT):
                        qi = qi + theta * h * qd[i]
                        if wp.static(LIMIT):
                            end_rate = end_rate + h * load(ck_a, row, VADR + link_of(m, k), e)
                    gain = passive_gain(m, law, k, qi, qd[i], end_rate)
                    if wp.static(VARIED and LIMIT):
                        if m.carried[k] == 1:  # of the lanes that have the joint
                            by = limit_constants_gain(m, law, k, qi, qd[i], end_rate, theta * h)
                            g_factors[K_LIMIT] = g_factors[K_LIMIT] - lam[i] * by[0]
                            g_factors[D_LIMIT] = g_factors[D_LIMIT] - lam[i] * by[1]
                    kv = gain[1]
                    if wp.static(IMPLICIT):
                        kv = kv + theta * h * gain[0]
                    xv = adj_v[i] - wp.spatial_cross_dual(V[p], adj_a[i])
                    gq[i] = (
                        gq[i]
                        + wp.dot(adj_p[i], S[i])
                        - wp.dot(xv, wp.spatial_cross(S[i], V[p]))
                        - wp.dot(adj_w[i], wp.spatial_cross(S[i], W[p]))
                        - wp.dot(adj_a[i], wp.spatial_cross(S[i], A[p]))
                        - lam[i] * gain[0]
                    )
                    gqd[i] = gqd[i] + wp.dot(xv - wp.spatial_cross_dual(V[turned], adj_a[i]), S[i]) - lam[i] * kv
                    gtau[i] = gtau[i] - lam[i]
                    if wp.static(NBALL > 0):
                        p = m.parent[k]
                    if wp.static(FLOATING) or p > 0:
                        adj_a[p] = adj_a[p] + adj_a[i]
                        adj_v[p] = adj_v[p] + adj_v[i]
                        adj_w[p] = adj_w[p] + adj_w[i]
                        adj_p[p] = adj_p[p] + adj_p[i]
            if wp.static(BALL_SPRING):
                # The spring sees the rotation vector, whose derivative in the tangent space is not the identity.
                for b in range(m.ball_count[lane]):
                    i = m.ball_slot[lane * NBALL + b]
                    lb = vec3(lam[i], lam[i + 1], lam[i + 2])
                    lb = m.stiffness[at + i] * (log_adjoint(vec3(q[i], q[i + 1], q[i + 2]), lb) - lb)
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
                tw = xv - wp.spatial_cross_dual(V[0], adj_a[0])
                gp = gp + wp.spatial_bottom(adj_p[0])
                gr = gr + wp.transpose(R[0]) * wp.spatial_top(tq)
                gv = gv + wp.spatial_bottom(xv)
                gw = gw + wp.transpose(R[0]) * wp.spatial_top(tw)

        # A gradient that left the finite numbers, or of a contained step, is zero.
        broken = T(0.0)
        for i in range(1, n):
            if not (wp.isfinite(gq[i]) and wp.isfinite(gqd[i]) and wp.isfinite(gtau[i])):
                broken = T(1.0)
        if wp.static(FLOATING):
            for k in range(3):
                if not (wp.isfinite(gp[k]) and wp.isfinite(gr[k]) and wp.isfinite(gv[k]) and wp.isfinite(gw[k])):
                    broken = T(1.0)
        if wp.static(MUSCLE):
            for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                k = m.muscle[entry]
                if not wp.isfinite(g_pull[k]):
                    broken = T(1.0)
        if wp.static(VARIED):
            for k in range(NFACTORS):
                if not wp.isfinite(g_factors[k]):
                    broken = T(1.0)
        if wp.static(FORCED):
            if not finite_forces(m, at, g_forces):
                broken = T(1.0)
        if wp.static(THREADS_PER_ENV > 1):
            broken = add(broken)
        finite = broken == T(0.0)
        contained = nonfinite[e]
        if lane == 0 and not finite and not contained:
            nonfinite_gradients[e] = nonfinite_gradients[e] + 1
        keep = finite and not contained
        for k in range(NU):
            if m.motor_lane[k] == lane:
                g = T(0.0)
                if wp.static(DRIVEN):
                    g = gtau[m.motor_slot[lane * NU + k]]
                if wp.static(MUSCLE):
                    g = g + g_pull[k]
                if wp.static(VARIED):
                    g_factors[MOTOR] = g_factors[MOTOR] + g * (m.gear[k] * ctrl[e, k] + m.motor_bias[k])
                    g = law.motor * g
                g_ctrl[e, k] = wp.where(keep, g * m.gear[k], T(0.0))
        if wp.static(VARIED):
            for k in range(NFACTORS):
                total = g_factors[k]
                if wp.static(THREADS_PER_ENV > 1):
                    total = add(total)
                if lane == 0:
                    g_ctrl[e, NU + k] = wp.where(keep, total, T(0.0))
        if wp.static(FORCED):
            write_forces_adjoint(m, at, e, keep, g_forces, g_ctrl)
        for i in range(1, n):
            g_qpos[e, qpos_adr(m, at + i)] = wp.where(keep, gq[i], T(0.0))
            g_qvel[e, VADR + link_of(m, at + i)] = wp.where(keep, gqd[i], T(0.0))
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[lane]):
                i = m.ball_slot[lane * NBALL + b]
                adr = qpos_adr(m, at + i)
                gb4 = from_tangent(load_quat(qpos, e, adr), vec3(gq[i], gq[i + 1], gq[i + 2]))
                g_qpos[e, adr] = wp.where(keep, gb4[3], T(0.0))
                for k in range(3):
                    g_qpos[e, adr + 1 + k] = wp.where(keep, gb4[k], T(0.0))
        if wp.static(FLOATING):
            g4 = from_tangent(load_quat(qpos, e, 3), gr)
            for k in range(3):
                g_qpos[e, k] = wp.where(keep, gp[k], T(0.0))
                g_qpos[e, 4 + k] = wp.where(keep, g4[k], T(0.0))
                g_qvel[e, k] = wp.where(keep, gv[k], T(0.0))
                g_qvel[e, 3 + k] = wp.where(keep, gw[k], T(0.0))
            g_qpos[e, 3] = wp.where(keep, g4[3], T(0.0))

    return backward

"""The mass matrix: sweeps that factorise it and solve for accelerations, and M lambda = -h g with that factor."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.tree.kinematics import kinematics

# Phases of a substep: Newton's passes, the factor of the last iterate, the damped solve
NEWTON, FACTOR, SOLVE, DONE = range(4)


@cache
def base_inertia(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a floating base: the Cholesky factor of its articulated inertia, and its damping."""
    t, kin = types(spec), kinematics(spec)
    T, vec3, vec6, mat3, mat6 = t.T, t.vec3, t.vec6, t.mat3, t.mat6
    load, store, join = kin.load, kin.store, spatial(spec).join
    Model, Lane, Link, Load, Root = t.Model, t.Lane, t.Link, t.Load, t.Root
    CONSTRAINED, IMPLICIT = spec.constrained, spec.implicit
    BASE = 7 * (spec.nlink - 1)  # first column of the base's factor, packed by rows

    @wp.func
    def back_substitute(L: mat6, b: vec6):
        """Return L'^-1 b, the second half of a solve with a Cholesky factor L."""
        a = b
        for rr in range(6):
            r = 5 - rr
            y = a[r]
            for k in range(r + 1, 6):
                y = y - L[k, r] * a[k]
            a[r] = y * L[r, r]
        return a

    @wp.func
    def factor_base(Ia: mat3, Ib: mat3, Id: mat3, b: vec6):
        """Return the Cholesky factor (reciprocal diagonal) of the base's articulated inertia I, and I^-1 b."""
        L = mat6()
        for r in range(3):
            for c in range(3):
                L[r, c] = Ia[r, c]
                L[3 + r, c] = Ib[c, r]
                L[3 + r, 3 + c] = Id[r, c]
        a = vec6()
        for r in range(6):
            for c in range(r):
                s = L[r, c]
                for k in range(c):
                    s = s - L[r, k] * L[c, k]
                L[r, c] = s * L[c, c]
            s = L[r, r]
            y = b[r]
            for k in range(r):
                s = s - L[r, k] * L[r, k]
                y = y - L[r, k] * a[k]
            L[r, r] = T(1.0) / wp.sqrt(s)
            a[r] = y * L[r, r]
        return L, back_substitute(L, a)

    @wp.func
    def store_base(ck_f: t.array3, row: int, e: int, L: mat6):
        """Store the base's Cholesky factor in a row of the checkpoint."""
        k = int(BASE)
        for r in range(6):
            for c in range(r + 1):
                store(ck_f, row, k, e, L[r, c])
                k = k + 1

    @wp.func
    def solve_base(ck_f: t.array3, row: int, e: int, b: vec6):
        """Return I^-1 b by the base's stored Cholesky factor."""
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
    def damp_base(m: Model, here: Lane, last: bool, link: Link, load: Load, root: Root):
        """Add damping to the base's load, implicit where that of joints is: with constraints in the damped solve."""
        b = T(m.base_damping)
        hb = here.h * b
        implicit = int(IMPLICIT)
        if wp.static(CONSTRAINED):
            implicit = wp.where(last, 1, 0)
        if wp.static(CONSTRAINED) and implicit == 1:
            load.f = load.f + hb * join(link.R * root.newton_wdot, root.newton_vdot)
        else:
            load.f = load.f + b * link.V
            if wp.static(IMPLICIT):  # of the spatial acceleration, which lacks w x v and gravity
                load.f = load.f + hb * join(vec3(), wp.cross(wp.spatial_top(link.V), root.v) + vec3(m.gravity))
        if implicit == 1:
            load.a = load.a + wp.diag(vec3(hb, hb, hb))
            load.d = load.d + wp.diag(vec3(hb, hb, hb))
        return load

    return functions(locals())


@cache
def articulated(spec: KernelSpec) -> SimpleNamespace:
    """Make the articulated-body algorithm's second and third sweep; the first one is place_links."""
    t, kin, base, sums, joint = types(spec), kinematics(spec), base_inertia(spec), lane_sums(spec), joint_law(spec)
    T, vec3, vec6, store, link_of, join = t.T, t.vec3, t.vec6, kin.store, kin.link_of, spatial(spec).join
    Model, Lane, Ck, Link, Load, Motion, Root = t.Model, t.Lane, t.Checkpoint, t.Link, t.Load, t.Motion, t.Root
    Links, Motions, Loads = t.Links, t.Motions, t.Loads
    FLOATING, IMPLICIT, CONSTRAINED = spec.floating, spec.implicit, spec.constrained
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.slots
    BASE_DAMPED, CLAMP, TENDON_DAMPING = spec.has("base_damping clamp tendon_damping")
    PAIRS, BRANCHED = spec.pairs > 0, spec.branched

    @wp.func
    def joint_force(m: Model, here: Lane, k: int, phase: int, link: Link, motion: Motion, d: T):
        """Return a joint's force, and d = S . I S + armature with the implicit terms of its laws."""
        unclamped = T(1.0)
        if wp.static(CLAMP):
            unclamped = joint.actuator_unclamped(m, k, motion.motor, link.q, link.qd)
        if wp.static(IMPLICIT):
            resistance = joint.resistance(m, here, k, link.q, link.qd, unclamped)
            d = d + here.h * resistance[1]
            if wp.static(TENDON_DAMPING):
                d = d + here.h * motion.tendon_damping
        if wp.static(CONSTRAINED):
            if phase == SOLVE:
                damper = here.h * joint.end_damping(m, k, unclamped)
                if wp.static(TENDON_DAMPING):
                    damper = damper + here.h * motion.tendon_damping
                d = d + damper
                f = -damper * motion.accel_joint
            else:
                d = d + motion.con_slope
                f = motion.free_force + motion.con_force - T(m.armature[k]) * motion.accel_joint
                if wp.static(PAIRS):
                    f = f + motion.rate
        else:
            f = joint.force(m, here, k, motion.motor, link.q, link.qd)
        return f, d

    @wp.func
    def inward(m: Model, here: Lane, phase: int, ck: Ck, links: Links, motions: Motions, loads: Loads):
        """Compute articulated inertias and bias forces, and U, 1/d and u of each joint.

        If here.store_factor is 1, U and 1/d go into the checkpoint.
        """
        slots = int(SLOTS)
        if wp.static(SHARERS > 1):
            sums.sharers.add_loads(loads)
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_loads(loads)
            if i > 0 and i < here.n:
                k = here.at + i
                p = m.parent[k]
                S = links[i].S
                sa = wp.spatial_top(S)
                sl = wp.spatial_bottom(S)
                own = loads[i]
                Ua = own.a * sa + own.b * sl
                Ul = sa * own.b + own.d * sl
                Ui = join(Ua, Ul)
                d = wp.dot(S, Ui) + T(m.armature[k])
                f, d = joint_force(m, here, k, phase, links[i], motions[i], d)
                ui = f - wp.dot(S, own.f)
                di = T(1.0) / d
                if wp.static(FLOATING) or p > 0:
                    va = Ua * di
                    vl = Ul * di
                    if wp.static(CONSTRAINED):
                        loads[p].f = loads[p].f + own.f + join(va, vl) * ui
                    else:
                        C = motions[i].C
                        ca = wp.spatial_top(C)
                        cl = wp.spatial_bottom(C)
                        bias = join(own.a * ca + own.b * cl, ca * own.b + own.d * cl)
                        loads[p].f = loads[p].f + own.f + bias + join(va, vl) * (ui - wp.dot(Ui, C))
                    loads[p].a = loads[p].a + own.a - wp.outer(Ua, va)
                    loads[p].b = loads[p].b + own.b - wp.outer(Ua, vl)
                    loads[p].d = loads[p].d + own.d - wp.outer(Ul, vl)
                motions[i].U = Ui
                motions[i].dinv = di
                motions[i].u = ui
                if here.store_factor == 1:
                    f0 = 7 * (link_of(m, k) - 1)
                    for r in range(6):
                        store(ck.f, here.factor_row, f0 + r, here.e, Ui[r])
                    store(ck.f, here.factor_row, f0 + 6, here.e, di)

    @wp.func
    def accelerate(m: Model, here: Lane, phase: int, ck: Ck, links: Links, motions: Motions, load: Load, root: Root):
        """Compute accelerations, those of joints into u; load is the base's.

        Gravity is an acceleration of the base. With constraints the accelerations are a Newton step, from the imbalance
        of forces, and so without gravity and C.
        """
        motions[0].A = vec6()
        if wp.static(not CONSTRAINED):
            motions[0].A = join(vec3(), -vec3(m.gravity))
        if wp.static(FLOATING):
            if wp.static(BASE_DAMPED):
                load = base.damp_base(m, here, phase == SOLVE, links[0], load, root)
            L, a0 = base.factor_base(load.a, load.b, load.d, -load.f)
            motions[0].A = a0
            if wp.static(BRANCHED):
                root.L = L
            root.wdot = wp.transpose(links[0].R) * wp.spatial_top(a0)
            root.vdot = wp.spatial_bottom(a0)
            if wp.static(not CONSTRAINED):
                turning = wp.spatial_top(links[0].V)
                root.vdot = wp.spatial_bottom(a0) + wp.cross(turning, root.v) + vec3(m.gravity)
            if here.store_factor == 1:
                base.store_base(ck.f, here.factor_row, here.e, L)
        for i in range(1, here.n):
            ai = motions[m.parent[here.at + i]].A
            if wp.static(not CONSTRAINED):
                ai = ai + motions[i].C
            qdd = (motions[i].u - wp.dot(motions[i].U, ai)) * motions[i].dinv
            motions[i].A = ai + links[i].S * qdd
            motions[i].u = qdd
        return root

    return functions(locals())


def factor_solve(spec: KernelSpec, chain: SimpleNamespace | None, gyro: SimpleNamespace | None) -> wp.Function:
    """Make the adjoint's solves.

    chain: transmission.py's law if a tendon damps a chain of joints; gyro: gyroscope.py's with such free bodies.
    """
    t, kin, inertia, sums, joint = types(spec), kinematics(spec), base_inertia(spec), lane_sums(spec), joint_law(spec)
    T, vec6, load, link_of, join = t.T, t.vec6, kin.load, kin.link_of, spatial(spec).join
    Model, Lane, Ck, Links, Nodes, Base = t.Model, t.Lane, t.Checkpoint, t.Links, t.Nodes, t.Base
    FLOATING, SLOTS, SOLVES, DAMPED = spec.floating, spec.slots, spec.solves, spec.damped
    BASE_DAMPED, CLAMP, TENDON_DAMPING, CHAIN, GYROSCOPIC = spec.has(
        "base_damping clamp tendon_damping tendon_chain gyroscopic"
    )
    THREADS_PER_ENV, SHARERS, TRUNK = spec.threads_per_env, spec.sharers, spec.trunk

    @wp.func
    def solve(m: Model, here: Lane, ck: Ck, row: int, links: Links, nodes: Nodes, g_base: vec6):
        """Solve for lambda = -M^-1 h g and the twists W under it, into nodes; g_base is a floating base's.

        In the inward sweep, W holds the articulated bias force.
        """
        slots = int(SLOTS)
        h = here.h
        for i in range(here.n):
            nodes[i].W = vec6()
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_twists(nodes)
            if i > 0 and i < here.n:
                p = m.parent[here.at + i]
                W = nodes[i].W
                u = -h * nodes[i].g - wp.dot(links[i].S, W)
                nodes[i].u = u
                if wp.static(FLOATING) or p > 0:
                    f0 = 7 * (link_of(m, here.at + i) - 1)
                    Ui = vec6()
                    for r in range(6):
                        Ui[r] = load(ck.f, row, f0 + r, here.e)
                    nodes[p].W = nodes[p].W + W + Ui * (u * load(ck.f, row, f0 + 6, here.e))
        if wp.static(FLOATING):
            nodes[0].W = inertia.solve_base(ck.f, row, here.e, g_base * (-h) - nodes[0].W)
        for i in range(1, here.n):
            W = nodes[m.parent[here.at + i]].W
            f0 = 7 * (link_of(m, here.at + i) - 1)
            UW = T(0.0)
            for r in range(6):
                UW = UW + load(ck.f, row, f0 + r, here.e) * W[r]
            lam = (nodes[i].u - UW) * load(ck.f, row, f0 + 6, here.e)
            nodes[i].lam = lam
            nodes[i].W = W + links[i].S * lam

    @wp.func
    def solve_all(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes, base: Base):
        """Solve for lambda = -M^-1 h g.

        If damping follows the constraints, (M + h b) lambda1 = -h g comes first, with twists W1, and g + b lambda1 is
        the adjoint of the acceleration before damping.
        """
        g_base = vec6()
        if wp.static(FLOATING):
            g_base = join(links[0].R * base.gw, base.gv)
        damping_pass = T(0.0)  # not T(s): where the loop is unrolled, float64(s) makes s itself a float
        for s in range(SOLVES):
            if wp.static(DAMPED and BASE_DAMPED):
                g_base = g_base + damping_pass * T(m.base_damping) * nodes[0].W
            for i in range(here.n):
                nodes[i].g = nodes[i].gqd
                if wp.static(DAMPED):
                    nodes[i].W1 = nodes[i].W
                    unclamped = T(1.0)
                    if wp.static(CLAMP):
                        unclamped = nodes[i].unclamped
                    nodes[i].g = (
                        nodes[i].gqd + damping_pass * joint.end_damping(m, here.at + i, unclamped) * nodes[i].lam
                    )
                    if wp.static(TENDON_DAMPING):
                        nodes[i].g = nodes[i].g + damping_pass * nodes[i].tendon_damping * nodes[i].lam
            if wp.static(CHAIN):
                chain.add_damping(m, here, damping_pass, nodes)
            if wp.static(GYROSCOPIC):
                if s == 1:
                    g_base = gyro.add_transpose(m, here, links, nodes, g_base)
            solve(m, here, ck, SOLVES * here.row + s, links, nodes, g_base)
            if wp.static(CHAIN):
                if s == 0:
                    chain.correct_lambda(m, here, ck, links, nodes)
            if wp.static(GYROSCOPIC):
                if s == 0:
                    gyro.correct_lambda(m, here, links, nodes, g_base)
            damping_pass = T(1.0)

    return solve_all

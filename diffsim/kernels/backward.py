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

from diffsim.kernels.laws.force import external_force
from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.laws.muscle import muscle_law
from diffsim.kernels.mujoco.ground import ground_adjoint
from diffsim.kernels.mujoco.limits import joint_limits
from diffsim.kernels.pairs.adjoint import pair_adjoint
from diffsim.kernels.parameters import parameter_adjoint
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.lane import lane_of
from diffsim.kernels.thread.model import types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks, module_options
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.link import link_law
from diffsim.kernels.tree.solve import factor_solve


@cache
def backward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec3, vec6, quat, Model, Lane = t.T, t.vec3, t.vec6, t.quat, t.Model, t.Lane
    Link, Node, Adjoint, Base, Contact = t.Link, t.Node, t.Adjoint, t.Base, t.Contact
    Ck, Links, Nodes, Adjoints, Array = t.Checkpoint, t.Links, t.Nodes, t.Adjoints, t.Ts
    lane, join, load, link_of, qpos_adr = lane_of(spec), sp.join, kin.load, kin.link_of, kin.qpos_adr
    link, force, joint = link_law(spec), external_force(spec), joint_law(spec)
    muscle, parameters = muscle_law(spec), parameter_adjoint(spec)
    ground, limits = ground_adjoint(spec), joint_limits(spec)
    PAIRS, BLOCKS, pairs = spec.pairs > 0, spec.pair_sizes.blocks, pair_adjoint(spec) if spec.pairs else None
    CONSTRAINED, DAMPED, NV = spec.constrained, spec.damped, spec.nv
    CONTACT, DRIVEN, CLAMP, MUSCLE, LIMIT, BASE_DAMPED = spec.has("contact motor clamp muscle limit base_damping")
    LIMIT = LIMIT and not spec.constrained  # the penalty law
    TENDON, SITE = spec.has("tendon site")
    transmission = transmission_law(spec) if TENDON or SITE else None
    solve = factor_solve(spec, transmission)
    NU, FLOATING, IMPLICIT, VARIED, FORCED = spec.nu, spec.floating, spec.implicit, spec.varied, spec.forced > 0
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    read, write, pick = block.read, block.write, block.pick
    VADR, NBALL, BALL_SPRING = spec.dof0 - 1, spec.nball, spec.nball > 0 and "stiffness" in spec.features
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.room
    # Local arrays have at least one element, also where they are not read.
    LEARNED, NPARAMETERS = spec.parameters > 0, max(spec.parameters, 1)
    PULLED = MUSCLE or TENDON or SITE
    TENSIONS, BODIES = (NU if PULLED else 1), max(spec.forced, 1)

    @wp.func
    def load_vec3(a: t.array3, here: Lane, k: int):
        """Load three velocities or accelerations from a checkpoint's row."""
        return vec3(load(a, here.row, k, here.e), load(a, here.row, k + 1, here.e), load(a, here.row, k + 2, here.e))

    @wp.func
    def end_velocity(ck: Ck, here: Lane, k: int):
        """Compute three velocities at the end of the substep."""
        return load_vec3(ck.v, here, k) + here.h * load_vec3(ck.a, here, k)

    @wp.func
    def read_end_gradient(m: Model, here: Lane, ck: Ck, g: t.Batch, nodes: Nodes):
        """Read the gradient of the state after the substep here.row into nodes; returns the base's."""
        e = here.e
        for i in range(1, here.n):
            nodes[i].gq = read(g.qpos_out, e, qpos_adr(m, here.at + i))
            nodes[i].gqd = read(g.qvel_out, e, VADR + link_of(m, here.at + i))
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                i = m.ball_slot[here.lane * NBALL + b]
                adr = qpos_adr(m, here.at + i)
                wb = end_velocity(ck, here, VADR + link_of(m, here.at + i))
                rot_b = wp.normalize(kin.load_quat_row(ck.q, here.row, adr, e) * sp.exp_quat(here.h * wb))
                gb = sp.to_tangent(rot_b, kin.load_quat(g.qpos_out, e, adr))
                for k in range(3):
                    nodes[i + k].gq = gb[k]
        base = Base()
        if wp.static(FLOATING):
            w = end_velocity(ck, here, 3)
            rot = wp.normalize(kin.load_quat_row(ck.q, here.row, 3, e) * sp.exp_quat(here.h * w))
            base.gp = vec3(read(g.qpos_out, e, 0), read(g.qpos_out, e, 1), read(g.qpos_out, e, 2))
            base.gr = sp.to_tangent(rot, kin.load_quat(g.qpos_out, e, 3))
            base.gv = vec3(read(g.qvel_out, e, 0), read(g.qvel_out, e, 1), read(g.qvel_out, e, 2))
            base.gw = vec3(read(g.qvel_out, e, 3), read(g.qvel_out, e, 4), read(g.qvel_out, e, 5))
        return base

    @wp.func
    def recompute_balls(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes):
        """Recompute the ball joints' rotations into links, and apply their integrator's adjoint to nodes."""
        ball_rot = wp.zeros(shape=wp.static(max(NBALL, 1)), dtype=quat)
        for b in range(m.ball_count[here.lane]):
            i = m.ball_slot[here.lane * NBALL + b]
            ball_rot[b] = kin.load_quat_row(ck.q, here.row, qpos_adr(m, here.at + i), here.e)
            gb = vec3(nodes[i].gq, nodes[i + 1].gq, nodes[i + 2].gq)
            velocity = end_velocity(ck, here, VADR + link_of(m, here.at + i))
            gb_turn, gb_start = sp.exp_adjoint(here.h * velocity, gb)
            for k in range(3):
                nodes[i + k].gqd = nodes[i + k].gqd + here.h * (gb_turn[k] - gb[k])
                nodes[i + k].gq = gb_start[k]
        kin.place_balls(m, here, ball_rot, links)

    @wp.func
    def recompute_base(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes, base: Base):
        """Recompute the floating base's motion into links[0] and nodes[0]; returns its integrator's adjoint."""
        rot = kin.load_quat_row(ck.q, here.row, 3, here.e)
        v = load_vec3(ck.v, here, 0)
        w = load_vec3(ck.v, here, 3)
        vdot = load_vec3(ck.a, here, 0) - vec3(m.gravity)
        wdot = load_vec3(ck.a, here, 3)
        g_turn, gr_start = sp.exp_adjoint(here.h * (w + here.h * wdot), base.gr)
        base.gv = base.gv + here.h * base.gp
        base.gw = base.gw + here.h * g_turn
        base.gr = gr_start
        R = wp.quat_to_matrix(rot)
        links[0].R = R
        links[0].V = join(R * w, v)
        if wp.static(DAMPED):
            nodes[0].D = join(R * wdot, vdot)
        if wp.static(CONSTRAINED):
            vdot = load_vec3(ck.a, here, NV) - vec3(m.gravity)
            wdot = load_vec3(ck.a, here, NV + 3)
        if wp.static(DAMPED):
            nodes[0].D = nodes[0].D - join(R * wdot, vdot)
        nodes[0].A = join(R * wdot, vdot - wp.cross(R * w, v))
        if wp.static(CONSTRAINED):
            nodes[0].B = join(R * wdot, vdot + vec3(m.gravity))
        base.v = v
        base.vdot = vdot
        return base

    @wp.func
    def recompute_joints(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes):
        """Recompute the links' accelerations into nodes."""
        for i in range(1, here.n):
            k = here.at + i
            p = m.parent[k]
            own = links[i]
            turning = i
            if wp.static(NBALL > 0):
                turning = m.inboard[k]
            adr = VADR + link_of(m, k)
            qdd = load(ck.a, here.row, int(CONSTRAINED) * NV + adr, here.e)
            nodes[i].A = nodes[p].A + own.S * qdd + wp.spatial_cross(links[turning].V, own.S * own.qd)
            if wp.static(CONSTRAINED):
                nodes[i].qacc = qdd
                nodes[i].B = nodes[p].B + own.S * qdd
            if wp.static(DAMPED):
                nodes[i].D = nodes[p].D + own.S * (load(ck.a, here.row, adr, here.e) - qdd)
            if wp.static(CLAMP):
                nodes[i].unclamped = joint.actuator_unclamped(m, k, nodes[i].motor, own.q, own.qd)

    @wp.func
    def partials(
        # model
        m: Model,
        here: Lane,
        # state in
        links: Links,
        nodes: Nodes,
        carrier: t.CarrierPos,
        ck: Ck,
        # out
        adj: Adjoints,
        adj_parameters: Array,
    ):
        """Compute the partial derivatives of phi of each link into adj."""
        for i in range(1, INERT + 1):
            adj[i] = Adjoint()
        s = int(0)  # the contact in the checkpoint
        for i in range(FIRST, here.n):
            k = here.at + i
            own = link.link_adjoint(m, here, k, links[i], nodes[i], carrier)
            if wp.static(CONSTRAINED and CONTACT):
                own, s = ground.add_contacts_adjoint(
                    m, here, k, s, links[i], nodes[i], carrier, ck, own, adj_parameters
                )
            if wp.static(DAMPED):
                own = link.add_damping_adjoint(m, here, k, links[i], nodes[i], own)
            adj[i] = own

    @wp.func
    def joint_derivatives(m: Model, here: Lane, i: int, ck: Ck, link: Link, own: Node):
        """Differentiate the joint's force with respect to q and qd, and to that of its motors."""
        k = here.at + i
        end_qd = link.qd
        if wp.static(IMPLICIT and LIMIT):
            end_qd = end_qd + here.h * load(ck.a, here.row, VADR + link_of(m, k), here.e)
        unclamped = T(1.0)
        if wp.static(CLAMP):
            unclamped = own.unclamped
        derivatives = joint.derivatives(m, here, k, link.q, link.qd, end_qd, unclamped)
        if wp.static(CONSTRAINED):
            derivatives = derivatives + limits.joint_derivatives(m, here, k, link.q, link.qd, own.qacc)
        return derivatives, unclamped

    @wp.func
    def inward(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes, adj: Adjoints):
        """Sum adj over subtrees and project it on the joints."""
        slots = int(SLOTS)
        if wp.static(SHARERS > 1):
            sums.sharers.add_adjoints(adj)
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_adjoints(adj)
            if i > 0 and i < here.n:
                k = here.at + i
                p = m.parent[k]
                turned = i
                if wp.static(NBALL > 0):
                    p = m.inboard[k]
                    turned = m.outboard[k]
                own = nodes[i]
                derivatives, unclamped = joint_derivatives(m, here, i, ck, links[i], own)
                S = links[i].S
                total = adj[i]
                xv = total.v - wp.spatial_cross_dual(links[p].V, total.a)
                gq = (
                    own.gq
                    + wp.dot(total.p, S)
                    - wp.dot(xv, wp.spatial_cross(S, links[p].V))
                    - wp.dot(total.w, wp.spatial_cross(S, nodes[p].W))
                    - wp.dot(total.a, wp.spatial_cross(S, nodes[p].A))
                    - own.lam * derivatives[0]
                )
                if wp.static(CONSTRAINED):
                    gq = gq - wp.dot(total.b, wp.spatial_cross(S, nodes[p].B))
                if wp.static(DAMPED):
                    gq = gq - wp.dot(total.d, wp.spatial_cross(S, nodes[p].D))
                    gq = gq - wp.dot(total.w1, wp.spatial_cross(S, nodes[p].W1))
                nodes[i].gq = gq
                xa = xv - wp.spatial_cross_dual(links[turned].V, total.a)
                nodes[i].gqd = own.gqd + wp.dot(xa, S) - own.lam * derivatives[1]
                nodes[i].gtau = own.gtau - unclamped * own.lam
                if wp.static(NBALL > 0):
                    p = m.parent[k]
                if wp.static(FLOATING) or p > 0:
                    adj[p] = link.add_adjoints(adj[p], total)

    @wp.func
    def ball_springs(m: Model, here: Lane, links: Links, nodes: Nodes):
        """Correct the springs' gradient: a rotation vector's derivative in the tangent space is not the identity."""
        for b in range(m.ball_count[here.lane]):
            i = m.ball_slot[here.lane * NBALL + b]
            lb = vec3(nodes[i].lam, nodes[i + 1].lam, nodes[i + 2].lam)
            rotation = vec3(links[i].q, links[i + 1].q, links[i + 2].q)
            lb = T(m.stiffness[here.at + i]) * (sp.log_adjoint(rotation, lb) - lb)
            for k in range(3):
                nodes[i + k].gq = nodes[i + k].gq + lb[k]

    @wp.func
    def base_inward(m: Model, link: Link, own: Node, adj: Adjoint, base: Base):
        """Project adj on the base: a translation, whose "parent" twists are purely linear, then a ball joint."""
        vp = join(vec3(), base.v)
        wl = join(vec3(), wp.spatial_bottom(own.W))
        ap = join(vec3(), base.vdot)
        xv = adj.v - wp.spatial_cross_dual(vp, adj.a)
        tq = adj.p - wp.spatial_cross_dual(vp, xv)
        tq = tq - wp.spatial_cross_dual(wl, adj.w) - wp.spatial_cross_dual(ap, adj.a)
        if wp.static(CONSTRAINED):
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.B)), adj.b)
        if wp.static(DAMPED):
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.D)), adj.d)
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.W1)), adj.w1)
        tw = xv - wp.spatial_cross_dual(link.V, adj.a)
        base.gp = base.gp + wp.spatial_bottom(adj.p)
        base.gr = base.gr + wp.transpose(link.R) * wp.spatial_top(tq)
        base.gv = base.gv + wp.spatial_bottom(xv)
        base.gw = base.gw + wp.transpose(link.R) * wp.spatial_top(tw)
        if wp.static(BASE_DAMPED):  # its force is one on v and w, wherever the base is
            base.gv = base.gv + T(m.base_damping) * wp.spatial_bottom(own.W)
            base.gw = base.gw + T(m.base_damping) * (wp.transpose(link.R) * wp.spatial_top(own.W))
        return base

    @wp.func
    def count_nonfinite(
        m: Model, here: Lane, base: Base, nodes: Nodes, adj_tension: Array, adj_parameters: Array, adj_forces: t.vec6s
    ):
        """Count numbers of the gradient that are not finite."""
        failed = T(0.0)
        for i in range(1, here.n):
            failed = failed + block.is_nonfinite(nodes[i].gq) + block.is_nonfinite(nodes[i].gqd)
            failed = failed + block.is_nonfinite(nodes[i].gtau)
        if wp.static(FLOATING):
            for k in range(3):
                failed = failed + block.is_nonfinite(base.gp[k]) + block.is_nonfinite(base.gr[k])
                failed = failed + block.is_nonfinite(base.gv[k]) + block.is_nonfinite(base.gw[k])
        if wp.static(MUSCLE):
            for entry in range(m.muscle_begin[here.lane], m.muscle_begin[here.lane + 1]):
                failed = failed + block.is_nonfinite(adj_tension[m.muscle[entry]])
        if wp.static(TENDON or SITE):
            failed = failed + transmission.count_nonfinite(adj_tension)
        if wp.static(LEARNED):
            for k in range(NPARAMETERS):
                failed = failed + block.is_nonfinite(adj_parameters[k])
        if wp.static(FORCED):
            failed = failed + force.count_nonfinite_forces(m, here, adj_forces)
        if wp.static(THREADS_PER_ENV > 1):
            failed = sums.add(failed)
        return failed

    @wp.func
    def write_gradient(out: t.array2, e: int, column: int, drop: T, value: T):
        """Write the value, and 0 where the gradient is dropped."""
        write(out, e, column, pick(T(0.0), drop, T(0.0), value))

    @wp.func
    def write_controls(
        # model
        m: Model,
        here: Lane,
        # controls and gradients in
        drop: T,
        nodes: Nodes,
        adj_tension: Array,
        adj_parameters: Array,
        # out
        g: t.Batch,
    ):
        """Write the gradients of controls and parameters."""
        for k in range(NU):
            if m.motor_lane[k] == here.lane:
                g_force = T(0.0)
                if wp.static(DRIVEN):
                    g_force = nodes[m.motor_slot[here.lane * NU + k]].gtau
                if wp.static(PULLED):
                    g_force = g_force + adj_tension[k]
                if wp.static(VARIED):
                    g_force = here.motor * g_force
                write_gradient(g.ctrl, here.e, k, drop, g_force * T(m.gear[k]))
        if wp.static(LEARNED):
            for k in range(NPARAMETERS):
                total = adj_parameters[k]
                if wp.static(THREADS_PER_ENV > 1):
                    total = sums.add(total)
                if here.lane == 0:
                    write_gradient(g.factors, here.e, k, drop, total)

    @wp.func
    def write_state(m: Model, here: Lane, drop: T, qpos: t.array2, base: Base, nodes: Nodes, g: t.Batch):
        """Write the gradients of qpos and qvel."""
        e = here.e
        for i in range(1, here.n):
            write_gradient(g.qpos, e, qpos_adr(m, here.at + i), drop, nodes[i].gq)
            write_gradient(g.qvel, e, VADR + link_of(m, here.at + i), drop, nodes[i].gqd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                i = m.ball_slot[here.lane * NBALL + b]
                adr = qpos_adr(m, here.at + i)
                gb = vec3(nodes[i].gq, nodes[i + 1].gq, nodes[i + 2].gq)
                gb4 = sp.from_tangent(kin.load_quat(qpos, e, adr), gb)
                write_gradient(g.qpos, e, adr, drop, gb4[3])
                for k in range(3):
                    write_gradient(g.qpos, e, adr + 1 + k, drop, gb4[k])
        if wp.static(FLOATING):
            g4 = sp.from_tangent(kin.load_quat(qpos, e, 3), base.gr)
            for k in range(3):
                write_gradient(g.qpos, e, k, drop, base.gp[k])
                write_gradient(g.qpos, e, 4 + k, drop, g4[k])
                write_gradient(g.qvel, e, k, drop, base.gv[k])
                write_gradient(g.qvel, e, 3 + k, drop, base.gw[k])
            write_gradient(g.qpos, e, 3, drop, g4[3])

    @wp.kernel(module="unique", module_options=module_options(spec))
    def backward(
        # model
        m: Model,
        first: int,  # block of this launch
        # options
        seconds: t.U,  # length of a substep
        substeps: int,
        # checkpoint in
        row0: int,
        ck: t.Checkpoint,
        # state in
        batch: t.Batch,  # whose quaternions may have any length
        nonfinite: wp.array(dtype=wp.bool),  # environments that kept their state
        # gradients, of the new state in, of all else out
        g: t.Batch,
        # out
        nonfinite_gradients: wp.array(dtype=int),
    ):
        here = lane(m, first, wp.tid(), T(seconds), batch.factors)
        links = wp.zeros(shape=SLOTS, dtype=Link)
        nodes = wp.zeros(shape=SLOTS, dtype=Node)
        adj = wp.zeros(shape=SLOTS, dtype=Adjoint)
        if wp.static(PAIRS):
            contacts = wp.zeros(shape=BLOCKS, dtype=Contact)
        adj_parameters = wp.zeros(shape=NPARAMETERS, dtype=T)
        adj_forces = wp.zeros(shape=BODIES, dtype=vec6)
        tension = wp.zeros(shape=TENSIONS, dtype=T)
        adj_tension = wp.zeros(shape=TENSIONS, dtype=T)
        if wp.static(CLAMP and not TENDON):
            joint.motors_backward(m, here, batch.ctrl, nodes)
        if wp.static(MUSCLE):
            muscle.compute_tensions(m, here, batch.ctrl, tension)
        links[0].R = wp.identity(3, dtype=T)
        here.row = row0 + substeps - 1
        base = read_end_gradient(m, here, ck, g, nodes)
        for sub in range(substeps):
            here.row = row0 + substeps - 1 - sub
            # 1. the state of this substep, and the adjoint of the integrator
            carrier = kin.carrier_position(m, T(0.0), T(0.0))
            nodes[0].A = join(vec3(), -vec3(m.gravity))
            for i in range(1, here.n):
                links[i].q = load(ck.q, here.row, qpos_adr(m, here.at + i), here.e)
                links[i].qd = load(ck.v, here.row, VADR + link_of(m, here.at + i), here.e)
                nodes[i].gqd = nodes[i].gqd + here.h * nodes[i].gq
            if wp.static(NBALL > 0):
                recompute_balls(m, here, ck, links, nodes)
            if wp.static(FLOATING):
                base = recompute_base(m, here, ck, links, nodes, base)
                carrier = kin.carrier_position(m, load(ck.q, here.row, 0, here.e), load(ck.q, here.row, 2, here.e))
            carrier = kin.place_links(m, here, links, carrier)
            if wp.static(TENDON):
                transmission.drive_backward(m, here, batch.ctrl, links, nodes)
            recompute_joints(m, here, ck, links, nodes)
            # 2. to 4.
            if wp.static(PAIRS):
                origin = vec3()
                if wp.static(FLOATING):
                    origin = load_vec3(ck.q, here, 0)
                here.end = pairs.recall(m, here, links, origin, ck, contacts)
            solve(m, here, ck, links, nodes, base)
            if wp.static(PAIRS):
                pairs.correct_lambda(m, here, links, ck, contacts, nodes)
            partials(m, here, links, nodes, carrier, ck, adj, adj_parameters)
            if wp.static(LEARNED):
                parameters.add_parameters(m, here, ck, links, nodes, batch.ctrl, adj_parameters)
            if wp.static(PAIRS):
                pairs.add_adjoint(m, here, links, contacts, nodes, adj, adj_parameters)
            if wp.static(FORCED):
                force.add_forces_adjoint(m, here, batch.forces, links, nodes, adj, adj_forces)
            if wp.static(MUSCLE):
                muscle.add_muscles_adjoint(m, here, tension, links, nodes, adj, adj_tension)
            if wp.static(TENDON):
                transmission.add_tendons_adjoint(m, here, batch.ctrl, links, nodes, adj_tension)
            if wp.static(SITE):
                transmission.add_sites_adjoint(m, here, batch.ctrl, links, nodes, adj, adj_tension)
            inward(m, here, ck, links, nodes, adj)
            if wp.static(BALL_SPRING):
                ball_springs(m, here, links, nodes)
            if wp.static(FLOATING):
                base = base_inward(m, links[0], nodes[0], adj[0], base)

        # A gradient that is not finite, or of an environment that kept its state, is zero.
        failed = count_nonfinite(m, here, base, nodes, adj_tension, adj_parameters, adj_forces)
        contained = block.read_flags(nonfinite, here.e)
        if here.lane == 0:
            block.count(nonfinite_gradients, here.e, pick(T(0.0), contained, T(0.0), failed))
        drop = failed + contained
        write_controls(m, here, drop, nodes, adj_tension, adj_parameters, g)
        if wp.static(FORCED):
            force.write_forces_adjoint(m, here, drop, adj_forces, g.forces)
        write_state(m, here, drop, batch.qpos, base, nodes, g)

    return backward

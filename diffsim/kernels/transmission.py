"""Actuators on fixed tendons and at sites, and their adjoint.

A fixed tendon has the length L = sum c q over its joints. Its actuator's force, clamped to its forcerange,

    F = gear ctrl + motor_bias - k L - d L',

acts on each joint with c F, so that a joint's force depends on the other joints, too. Of the implicit damping, the
matrix h d c c', MuJoCo keeps the entries of its mass matrix. Between joints that do not move each other these are those
of the diagonal, h d c^2 of each joint. Along a chain of joints they are all. This has one tendon at most, with the
solution (Sherman and Morrison) by two solves with the damped factor, x and z:

    (M + h b) x = g,   (M + h b) z = c,   (M + h b + h d c c')^-1 g = x - z h d c.x / (1 + h d c.z).

At a site the force makes a wrench that is constant in its link's frame. The link turns it together with all of its
motion, so that it adds nothing to the adjoint of the link's pose.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.clamp import clamp_law
from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.laws.muscle import muscle_law
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.branches import branch_solver


@cache
def transmission_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the forces of actuators on fixed tendons and at sites, and their adjoint."""
    t, block, joint = types(spec), blocks(spec), joint_law(spec)
    T, vec3, Model, Lane, Links, Nodes, pick = t.T, t.vec3, t.Model, t.Lane, t.Links, t.Nodes, block.pick
    wrench_to_world, clamped = muscle_law(spec).wrench_to_world, clamp_law(spec).clamped
    VARIED, NU, FLOATING = spec.varied, spec.nu, spec.floating
    TENDON, DAMPED, CHAIN = spec.has("tendon tendon_damping tendon_chain")
    forward, backward = (branch_solver(spec, rows) if CHAIN else None for rows in ("Motions", "Nodes"))
    SOLVES = spec.solves

    @wp.func
    def control_force(m: Model, here: Lane, actuator: int, ctrl: t.array2):
        """Return the part of an actuator's force that its control decides."""
        force = T(m.gear[actuator]) * block.read(ctrl, here.e, actuator) + T(m.motor_bias[actuator])
        if wp.static(VARIED):
            force = here.motor * force
        return force

    @wp.func
    def tendon_force(m: Model, here: Lane, k: int, ctrl: t.array2, links: Links):
        """Return the force of tendon k's actuator, and 1 where that is within its bounds, else 0."""
        law = m.tendon_law[k]
        low = T(law[2])
        high = T(law[3])
        force = control_force(m, here, m.tendon_actuator[k], ctrl)
        for entry in range(m.tendon_begin[k], m.tendon_begin[k + 1]):
            own = links[m.tendon_slot[entry]]
            force = force - T(m.tendon_coef[entry]) * (T(law[0]) * own.q + T(law[1]) * own.qd)
        unclamped = pick(low, force, pick(force, high, T(1.0), T(0.0)), T(0.0))
        return clamped(force, low, high), unclamped

    def driver(rows: type, motors: wp.Function) -> wp.Function:
        @wp.func
        def drive(m: Model, here: Lane, ctrl: t.array2, links: Links, rows: rows):
            """Set the joints' motor forces, with those of tendons, and the implicit damping, a chain's in slot 0."""
            for i in range(here.n):
                rows[i].motor = T(0.0)
                if wp.static(DAMPED):
                    rows[i].tendon_damping = T(0.0)
            motors(m, here, ctrl, rows)
            for k in range(m.tendon_actuator.shape[0]):
                force, unclamped = tendon_force(m, here, k, ctrl, links)
                damping = unclamped * T(m.tendon_law[k][1])
                if wp.static(CHAIN):
                    if k == m.tendon_chain[0]:
                        rows[0].tendon_damping = damping
                        damping = T(0.0)
                for entry in range(m.tendon_begin[k], m.tendon_begin[k + 1]):
                    i = m.tendon_slot[entry]
                    c = T(m.tendon_coef[entry])
                    rows[i].motor = rows[i].motor + c * force
                    if wp.static(DAMPED):
                        rows[i].tendon_damping = rows[i].tendon_damping + damping * c * c

        return drive

    drive_forward = driver(t.Motions, joint.motors_forward) if TENDON else None
    drive_backward = driver(t.Nodes, joint.motors_backward) if TENDON else None

    @wp.func
    def chain_range(m: Model):
        """Return where the damped chain's joints begin and end."""
        k = m.tendon_chain[0]
        return m.tendon_begin[k], m.tendon_begin[k + 1]

    @wp.func
    def correct_change(m: Model, here: Lane, links: Links, motions: t.Motions, root: t.Root):
        """Turn the change of the accelerations by damping into that with a chain's damping, too."""
        begin, end = chain_range(m)
        forward.clear(motions)
        for entry in range(begin, end):
            motions[m.tendon_slot[entry]].rate = T(m.tendon_coef[entry])
        forward.solve_tree(m, here, links, motions, root.L)
        cx = T(0.0)
        cz = T(0.0)
        for entry in range(begin, end):
            own = motions[m.tendon_slot[entry]]
            cx = cx + T(m.tendon_coef[entry]) * (own.accel_joint + own.u)
            cz = cz + T(m.tendon_coef[entry]) * own.rate
        hd = here.h * motions[0].tendon_damping
        force = -hd * cx / (T(1.0) + hd * cz)
        for i in range(1, here.n):
            motions[i].u = motions[i].u + force * motions[i].rate
        if wp.static(FLOATING):
            root.wdot = root.wdot + force * (wp.transpose(links[0].R) * wp.spatial_top(motions[0].twist))
            root.vdot = root.vdot + force * wp.spatial_bottom(motions[0].twist)
        return root

    @wp.func
    def correct_lambda(m: Model, here: Lane, ck: t.Checkpoint, links: Links, nodes: Nodes):
        """Do the same with the damped lambda and the twists under it."""
        begin, end = chain_range(m)
        L = backward.recall_factor(here, ck, SOLVES * here.row, nodes)
        backward.clear(nodes)
        for entry in range(begin, end):
            nodes[m.tendon_slot[entry]].rate = T(m.tendon_coef[entry])
        backward.solve_tree(m, here, links, nodes, L)
        cx = T(0.0)
        cz = T(0.0)
        for entry in range(begin, end):
            own = nodes[m.tendon_slot[entry]]
            cx = cx + T(m.tendon_coef[entry]) * own.lam
            cz = cz + T(m.tendon_coef[entry]) * own.rate
        hd = here.h * nodes[0].tendon_damping
        force = -hd * cx / (T(1.0) + hd * cz)
        for i in range(here.n):
            nodes[i].lam = nodes[i].lam + force * nodes[i].rate
            nodes[i].W = nodes[i].W + force * nodes[i].twist

    @wp.func
    def add_damping(m: Model, here: Lane, scale: T, nodes: Nodes):
        """Add d c c' lambda, times a scale, to the right-hand side of the solve."""
        begin, end = chain_range(m)
        cx = T(0.0)
        for entry in range(begin, end):
            cx = cx + T(m.tendon_coef[entry]) * nodes[m.tendon_slot[entry]].lam
        for entry in range(begin, end):
            i = m.tendon_slot[entry]
            nodes[i].g = nodes[i].g + scale * nodes[0].tendon_damping * T(m.tendon_coef[entry]) * cx

    @wp.func
    def add_tendons_adjoint(m: Model, here: Lane, ctrl: t.array2, links: Links, nodes: Nodes, adj_force: t.Ts):
        """Add the tendons' part of phi to the gradients of joints and of the actuators' forces."""
        for k in range(m.tendon_actuator.shape[0]):
            _force, unclamped = tendon_force(m, here, k, ctrl, links)
            rate = T(0.0)  # of the length under lambda
            for entry in range(m.tendon_begin[k], m.tendon_begin[k + 1]):
                own = nodes[m.tendon_slot[entry]]
                within = T(1.0)
                if wp.static(spec.has("clamp")[0]):
                    within = own.unclamped
                rate = rate + T(m.tendon_coef[entry]) * within * own.lam
            rate = unclamped * rate
            for entry in range(m.tendon_begin[k], m.tendon_begin[k + 1]):
                i = m.tendon_slot[entry]
                c = T(m.tendon_coef[entry])
                nodes[i].gq = nodes[i].gq + T(m.tendon_law[k][0]) * c * rate
                nodes[i].gqd = nodes[i].gqd + T(m.tendon_law[k][1]) * c * rate
            actuator = m.tendon_actuator[k]
            adj_force[actuator] = adj_force[actuator] - rate

    @wp.func
    def site_wrench(m: Model, k: int, links: Links):
        """Return a site's link, and its wrench per force of its actuator."""
        i = m.site_slot[k]
        return i, wrench_to_world(links[i].R, links[i].x, vec3(m.site_torque[k]), vec3(m.site_force[k]))

    @wp.func
    def add_sites(m: Model, here: Lane, ctrl: t.array2, links: Links, loads: t.Loads):
        """Add the wrenches at sites to the links' bias forces."""
        for k in range(m.site_actuator.shape[0]):
            i, wrench = site_wrench(m, k, links)
            loads[i].f = loads[i].f - wrench * control_force(m, here, m.site_actuator[k], ctrl)

    @wp.func
    def add_sites_adjoint(
        m: Model, here: Lane, ctrl: t.array2, links: Links, nodes: Nodes, adj: t.Adjoints, adj_force: t.Ts
    ):
        """Add the sites' part of phi to the adjoints of the links and of the actuators' forces."""
        for k in range(m.site_actuator.shape[0]):
            i, wrench = site_wrench(m, k, links)
            actuator = m.site_actuator[k]
            adj[i].w = adj[i].w - wrench * control_force(m, here, actuator, ctrl)
            adj_force[actuator] = adj_force[actuator] - wp.dot(nodes[i].W, wrench)

    @wp.func
    def count_nonfinite(adj_force: t.Ts):
        """Count numbers that are not finite among the adjoints of the actuators' forces."""
        failed = T(0.0)
        for k in range(NU):
            failed = failed + block.is_nonfinite(adj_force[k])
        return failed

    return functions(locals())

"""The adjoint of one control step, written by hand: the solver is never differentiated.

A substep solves r(q, v, a, u) = M a + c - tau - J'f = 0, then v' = v + h a and q' = q (+) h v'. Its adjoint has four
stages:

    recompute       the substep's state from the checkpoint, and the integrator's adjoint: g is what reaches a
    solve           for lambda = -M^-1 g by two sweeps with the stored factor, and W_i, the twist of link i under it
    differentiate   phi, by the quantities of each link
    project         the sums of these derivatives over subtrees on the joints

The partial derivatives in q, v and u of the scalar

    phi = sum_i W_i . (I_i a_i + v_i x* I_i v_i - f_i) - lambda . tau

are the answer. Per link, adj_a = I W, adj_w = its net force, adj_v = I (W x v) - W x* I v + v x* I W + contacts, and
adj_p is the wrench on its pose. Turning a subtree together with all its motion leaves phi's inertial part unchanged, so
after summing over subtrees only the parent's quantities enter:

    adj_q += adj_p.S - (adj_v - v_p x* adj_a).(S x v_p) - adj_w.(S x W_p) - adj_a.(S x a_p) - lambda dtau/dq
    adj_v += (adj_v - (v_p + v_i) x* adj_a).S - lambda dtau/dv
    adj_u -= lambda gear

The adjoint of a rotation lives in the body's tangent space; quaternions appear where gradients enter and leave.
"""

from functools import cache

import warp as wp

from diffsim.kernels.gyroscope import gyroscope
from diffsim.kernels.laws.force import external_force
from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.laws.muscle import muscle_law
from diffsim.kernels.pairs.adjoint import pair_adjoint
from diffsim.kernels.parameters import parameter_adjoint
from diffsim.kernels.partials import partial_derivatives
from diffsim.kernels.state import gradient_access
from diffsim.kernels.thread.lane import lane_of
from diffsim.kernels.thread.model import types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks, module_options
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.integrator import integrator_adjoint
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.solve import factor_solve


@cache
def backward_kernel(spec: KernelSpec) -> wp.Kernel:
    """Make the kernel that takes gradients back through a control step of a specification."""
    t, kin, block, lane, join = types(spec), kinematics(spec), blocks(spec), lane_of(spec), spatial(spec).join
    T, vec3, vec6, Model, pick, load = t.T, t.vec3, t.vec6, t.Model, block.pick, kin.load
    Link, Node, Adjoint, Contact = t.Link, t.Node, t.Adjoint, t.Contact
    link_of, qpos_adr, gradient = kin.link_of, kin.qpos_adr, gradient_access(spec)
    euler, phi, parameters = integrator_adjoint(spec), partial_derivatives(spec), parameter_adjoint(spec)
    joint, force, muscle = joint_law(spec), external_force(spec), muscle_law(spec)
    CLAMP, MUSCLE, TENDON, SITE, STIFFNESS, GYROSCOPIC = spec.has("clamp muscle tendon site stiffness gyroscopic")
    transmission = transmission_law(spec) if TENDON or SITE else None
    gyro, pairs = gyroscope(spec) if GYROSCOPIC else None, pair_adjoint(spec) if spec.pairs else None
    solve = factor_solve(spec, transmission, gyro)
    PAIRS, LEARNED, FLOATING, FORCED = spec.pairs > 0, spec.parameters > 0, spec.floating, spec.forced > 0
    VADR, NBALL, SLOTS, BLOCKS = spec.dof0 - 1, spec.nball, spec.room, spec.pair_sizes.blocks
    # Local arrays have at least one element, also where they are not read.
    TENSIONS, BODIES = spec.nu if MUSCLE or TENDON or SITE else 1, max(spec.forced, 1)
    PARAMETERS = max(spec.parameters, 1)

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
        """Turn the gradient by the new state into those by the old one, controls, parameters and forces."""
        here = lane(m, first, wp.tid(), T(seconds), batch.factors)
        links = wp.zeros(shape=SLOTS, dtype=Link)
        nodes = wp.zeros(shape=SLOTS, dtype=Node)
        adj = wp.zeros(shape=SLOTS, dtype=Adjoint)
        if wp.static(PAIRS):
            contacts = wp.zeros(shape=BLOCKS, dtype=Contact)
        adj_parameters = wp.zeros(shape=PARAMETERS, dtype=T)
        adj_forces = wp.zeros(shape=BODIES, dtype=vec6)
        tension = wp.zeros(shape=TENSIONS, dtype=T)
        adj_tension = wp.zeros(shape=TENSIONS, dtype=T)
        if wp.static(CLAMP and not TENDON):
            joint.motors_backward(m, here, batch.ctrl, nodes)
        if wp.static(MUSCLE):
            muscle.compute_tensions(m, here, batch.ctrl, tension)
        links[0].R = wp.identity(3, dtype=T)
        here.row = row0 + substeps - 1
        base = gradient.read_end_gradient(m, here, ck, g, nodes)
        for sub in range(substeps):
            here.row = row0 + substeps - 1 - sub
            # recompute
            carrier = kin.carrier_position(m, T(0.0), T(0.0))
            nodes[0].A = join(vec3(), -vec3(m.gravity))
            for i in range(1, here.n):
                links[i].q = load(ck.q, here.row, qpos_adr(m, here.at + i), here.e)
                links[i].qd = load(ck.v, here.row, VADR + link_of(m, here.at + i), here.e)
                nodes[i].gqd = nodes[i].gqd + here.h * nodes[i].gq
            if wp.static(NBALL > 0):
                euler.recompute_balls(m, here, ck, links, nodes)
            if wp.static(FLOATING):
                base = euler.recompute_base(m, here, ck, links, nodes, base)
                carrier = kin.carrier_position(m, load(ck.q, here.row, 0, here.e), load(ck.q, here.row, 2, here.e))
            carrier = kin.place_links(m, here, links, carrier)
            if wp.static(TENDON):
                transmission.drive_backward(m, here, batch.ctrl, links, nodes)
            euler.recompute_joints(m, here, ck, links, nodes)
            # solve
            if wp.static(PAIRS):
                origin = vec3()
                if wp.static(FLOATING):
                    origin = euler.load_vec3(ck.q, here, 0)
                here.end = pairs.recall(m, here, links, origin, ck, contacts)
            solve(m, here, ck, links, nodes, base)
            if wp.static(PAIRS):
                pairs.correct_lambda(m, here, links, ck, contacts, nodes)
            # differentiate
            phi.differentiate(m, here, links, nodes, carrier, ck, adj, adj_parameters)
            if wp.static(LEARNED):
                parameters.add_parameters(m, here, ck, links, nodes, batch.ctrl, adj_parameters)
            if wp.static(PAIRS):
                pairs.add_adjoint(m, here, links, contacts, nodes, adj, adj_parameters)
            if wp.static(GYROSCOPIC):
                base = gyro.add_adjoint(m, here, links, nodes, base, adj_parameters)
            if wp.static(FORCED):
                force.add_forces_adjoint(m, here, batch.forces, links, nodes, adj, adj_forces)
            if wp.static(MUSCLE):
                muscle.add_muscles_adjoint(m, here, tension, links, nodes, adj, adj_tension)
            if wp.static(TENDON):
                transmission.add_tendons_adjoint(m, here, batch.ctrl, links, nodes, adj_tension)
            if wp.static(SITE):
                transmission.add_sites_adjoint(m, here, batch.ctrl, links, nodes, adj, adj_tension)
            # project
            phi.project(m, here, ck, links, nodes, adj)
            if wp.static(NBALL > 0 and STIFFNESS):
                phi.correct_ball_springs(m, here, links, nodes)
            if wp.static(FLOATING):
                base = phi.project_base(m, links[0], nodes[0], adj[0], base)

        # A gradient that is not finite, or of an environment that kept its state, is zero.
        failed = gradient.count_nonfinite(m, here, base, nodes, adj_tension, adj_parameters, adj_forces)
        contained = block.read_flags(nonfinite, here.e)
        if here.lane == 0:
            block.count(nonfinite_gradients, here.e, pick(T(0.0), contained, T(0.0), failed))
        drop = failed + contained
        gradient.write_controls(m, here, drop, nodes, adj_tension, adj_parameters, g)
        if wp.static(FORCED):
            force.write_forces_adjoint(m, here, drop, adj_forces, g.forces)
        gradient.write_state(m, here, drop, batch.qpos, base, nodes, g)

    return backward

"""Semi-implicit Euler with the exact quaternion exponential, and its adjoint."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import FAR, KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.kinematics import kinematics


@cache
def integrator(spec: KernelSpec) -> SimpleNamespace:
    """Make the step from accelerations to the next state."""
    t, block, exp_quat = types(spec), blocks(spec), spatial(spec).exp_quat
    T, vec3, Model, Lane, Root, pick = t.T, t.vec3, t.Model, t.Lane, t.Root, block.pick
    Links, Motions, Quats, FLOATING, NBALL = t.Links, t.Motions, t.quats, spec.floating, spec.nball

    @wp.func
    def advance_position(position: T, velocity: T, rounding_error: T, h: T):
        """Return the position after a substep and its rounding error so far, which is compensated beyond FAR."""
        end = position + h * velocity
        distant = pick(T(FAR), wp.abs(end), T(1.0), T(0.0))
        if block.any_of(distant):
            rounding_error = distant * (rounding_error + (velocity - (end - position) / h) * h)
            compensated = end + rounding_error
            rounding_error = rounding_error - (compensated - end)
            end = pick(T(0.0), distant, compensated, end)
        return end, rounding_error

    @wp.func
    def integrate(m: Model, here: Lane, links: Links, motions: Motions, ball_rot: Quats, root: Root):
        """Advance the joints, whose accelerations are motions' u, and the ball joints; returns the floating base."""
        h = here.h
        if wp.static(FLOATING):
            root.v = root.v + h * root.vdot
            root.w = root.w + h * root.wdot
            for k in range(3):
                end, rounding_error = advance_position(root.pos[k], root.v[k], root.rounding_error[k], h)
                root.pos[k] = end
                root.rounding_error[k] = rounding_error
            root.rot = wp.normalize(root.rot * exp_quat(h * root.w))
        for i in range(1, here.n):
            links[i].qd = links[i].qd + h * motions[i].u
            end, rounding_error = advance_position(links[i].q, links[i].qd, motions[i].rounding_error, h)
            links[i].q = end
            motions[i].rounding_error = rounding_error
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                i = m.ball_slot[here.lane * NBALL + b]
                velocity = vec3(links[i].qd, links[i + 1].qd, links[i + 2].qd)
                ball_rot[b] = wp.normalize(ball_rot[b] * exp_quat(h * velocity))
        return root

    return functions(locals())


@cache
def integrator_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make its adjoint, which recomputes a substep's state from the checkpoint."""
    t, sp, kin, joint = types(spec), spatial(spec), kinematics(spec), joint_law(spec)
    vec3, quat, Model, Lane, Ck, Base = t.vec3, t.quat, t.Model, t.Lane, t.Checkpoint, t.Base
    Links, Nodes, join, load, link_of, qpos_adr = t.Links, t.Nodes, sp.join, kin.load, kin.link_of, kin.qpos_adr
    CLAMP, CONSTRAINED, DAMPED = "clamp" in spec.features, spec.constrained, spec.damped
    NV, VADR, NBALL = spec.nv, spec.dof0 - 1, spec.nball

    @wp.func
    def load_vec3(a: t.array3, here: Lane, k: int):
        """Load three velocities or accelerations from a checkpoint's row."""
        return vec3(load(a, here.row, k, here.e), load(a, here.row, k + 1, here.e), load(a, here.row, k + 2, here.e))

    @wp.func
    def end_velocity(ck: Ck, here: Lane, k: int):
        """Compute three velocities at the end of the substep: those in qvel from k on."""
        return load_vec3(ck.v, here, k) + here.h * load_vec3(ck.a, here, k)

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

    return functions(locals())

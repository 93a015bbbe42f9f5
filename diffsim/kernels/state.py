"""A lane's state and its gradient: read from the arrays of a control step, recorded, checked and written back."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.force import external_force
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import MAX_POSITION, MAX_SPEED, KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.integrator import integrator_adjoint
from diffsim.kernels.tree.kinematics import kinematics


@cache
def state_access(spec: KernelSpec) -> SimpleNamespace:
    """Make the forward kernel's functions that read, record, check and write the state."""
    t, kin, sums, block = types(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec3, Model, Lane, Ck, Root = t.T, t.vec3, t.Model, t.Lane, t.Checkpoint, t.Root
    Links, Motions, Quats = t.Links, t.Motions, t.quats
    store, link_of, qpos_adr = kin.store, kin.link_of, kin.qpos_adr
    read, write, pick = block.read, block.write, block.pick
    FLOATING, NBALL, THREADS_PER_ENV = spec.floating, spec.nball, spec.threads_per_env
    VADR = spec.dof0 - 1  # link i's joint in qvel is VADR + i

    @wp.func
    def read_state(m: Model, here: Lane, batch: t.Batch, links: Links, ball_rot: Quats):
        """Read the joints' state into links and ball_rot; returns the floating base's."""
        e = here.e
        for i in range(1, here.n):
            links[i].q = read(batch.qpos, e, qpos_adr(m, here.at + i))
            links[i].qd = read(batch.qvel, e, VADR + link_of(m, here.at + i))
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                slot = m.ball_slot[here.lane * NBALL + b]
                ball_rot[b] = wp.normalize(kin.load_quat(batch.qpos, e, qpos_adr(m, here.at + slot)))
                for k in range(3):
                    links[slot + k].q = T(0.0)  # was a part of the quaternion; place_balls sets those of springs
        links[0].R = wp.identity(3, dtype=T)
        root = Root()
        if wp.static(FLOATING):
            root.pos = vec3(read(batch.qpos, e, 0), read(batch.qpos, e, 1), read(batch.qpos, e, 2))
            root.rot = wp.normalize(kin.load_quat(batch.qpos, e, 3))
            root.v = vec3(read(batch.qvel, e, 0), read(batch.qvel, e, 1), read(batch.qvel, e, 2))
            root.w = vec3(read(batch.qvel, e, 3), read(batch.qvel, e, 4), read(batch.qvel, e, 5))
        return root

    @wp.func
    def record_state(m: Model, here: Lane, ck: Ck, links: Links, ball_rot: Quats, root: Root):
        """Store the state at the start of the substep in the checkpoint."""
        e = here.e
        if wp.static(FLOATING):
            for k in range(3):
                store(ck.q, here.row, k, e, root.pos[k])
                store(ck.q, here.row, 4 + k, e, root.rot[k])
                store(ck.v, here.row, k, e, root.v[k])
                store(ck.v, here.row, 3 + k, e, root.w[k])
            store(ck.q, here.row, 3, e, root.rot[3])
        for i in range(1, here.n):
            store(ck.q, here.row, qpos_adr(m, here.at + i), e, links[i].q)
            store(ck.v, here.row, VADR + link_of(m, here.at + i), e, links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                adr = qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b])
                store(ck.q, here.row, adr, e, ball_rot[b][3])
                for k in range(3):
                    store(ck.q, here.row, adr + 1 + k, e, ball_rot[b][k])

    @wp.func
    def record_accelerations(m: Model, here: Lane, ck: Ck, column: int, vdot: vec3, wdot: vec3, motions: Motions):
        """Store accelerations in the checkpoint, from a column on: the base's, then those in motions' u."""
        if wp.static(FLOATING):
            for k in range(3):
                store(ck.a, here.row, column + k, here.e, vdot[k])
                store(ck.a, here.row, column + 3 + k, here.e, wdot[k])
        for i in range(1, here.n):
            store(ck.a, here.row, column + VADR + link_of(m, here.at + i), here.e, motions[i].u)

    @wp.func
    def exceeds_speed(velocity: T):
        """Return 1 where a velocity is beyond MAX_SPEED or NaN, else 0."""
        return pick(wp.abs(velocity), T(MAX_SPEED), T(0.0), T(1.0))

    @wp.func
    def exceeds_range(position: T):
        """Return 1 where a position is beyond MAX_POSITION or NaN, else 0."""
        return pick(wp.abs(position), T(MAX_POSITION), T(0.0), T(1.0))

    @wp.func
    def invalid_quaternion(batch: t.Batch, here: Lane, adr: int):
        """Return 1 where an input quaternion's square is near the ends of float32's range or NaN, else 0."""
        quaternion = kin.load_quat(batch.qpos, here.e, adr)
        square = wp.dot(quaternion, quaternion)
        return pick(T(1e-30), square, pick(square, T(1e30), T(0.0), T(1.0)), T(1.0))

    @wp.func
    def count_nonfinite(m: Model, here: Lane, batch: t.Batch, links: Links, ball_rot: Quats, root: Root):
        """Count numbers of the state that are not finite or out of bounds, and invalid input quaternions."""
        failed = T(0.0)
        if wp.static(FLOATING):
            for k in range(3):
                failed = failed + exceeds_range(root.pos[k]) + block.is_nonfinite(root.rot[k])
                failed = failed + exceeds_speed(root.v[k]) + exceeds_speed(root.w[k])
            failed = failed + block.is_nonfinite(root.rot[3]) + invalid_quaternion(batch, here, 3)
        for i in range(1, here.n):
            failed = failed + exceeds_range(links[i].q) + exceeds_speed(links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                adr = qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b])
                failed = failed + invalid_quaternion(batch, here, adr)
                for k in range(4):
                    failed = failed + block.is_nonfinite(ball_rot[b][k])
        if wp.static(THREADS_PER_ENV > 1):
            failed = sums.add(failed)
        return failed

    @wp.func
    def write_or_restore(out: t.array2, start: t.array2, e: int, column: int, failed: T, value: T):
        """Write the value, and in failed environments the value before the step."""
        write(out, e, column, pick(T(0.0), failed, read(start, e, column), value))

    @wp.func
    def write_state(m: Model, here: Lane, failed: T, batch: t.Batch, links: Links, ball_rot: Quats, root: Root):
        """Write the state, and that of before the step where failed is not 0."""
        e = here.e
        if wp.static(FLOATING):
            for k in range(3):
                write_or_restore(batch.qpos_out, batch.qpos, e, k, failed, root.pos[k])
                write_or_restore(batch.qpos_out, batch.qpos, e, 4 + k, failed, root.rot[k])
                write_or_restore(batch.qvel_out, batch.qvel, e, k, failed, root.v[k])
                write_or_restore(batch.qvel_out, batch.qvel, e, 3 + k, failed, root.w[k])
            write_or_restore(batch.qpos_out, batch.qpos, e, 3, failed, root.rot[3])
        for i in range(1, here.n):
            write_or_restore(batch.qpos_out, batch.qpos, e, qpos_adr(m, here.at + i), failed, links[i].q)
            write_or_restore(batch.qvel_out, batch.qvel, e, VADR + link_of(m, here.at + i), failed, links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                adr = qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b])
                write_or_restore(batch.qpos_out, batch.qpos, e, adr, failed, ball_rot[b][3])
                for k in range(3):
                    write_or_restore(batch.qpos_out, batch.qpos, e, adr + 1 + k, failed, ball_rot[b][k])

    return functions(locals())


@cache
def gradient_access(spec: KernelSpec) -> SimpleNamespace:
    """Make the backward kernel's functions that read, check and write the gradient."""
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec3, Model, Lane, Ck, Base = t.T, t.vec3, t.Model, t.Lane, t.Checkpoint, t.Base
    Nodes, Array = t.Nodes, t.Ts
    force, end_velocity = external_force(spec), integrator_adjoint(spec).end_velocity
    link_of, qpos_adr, read, write, pick = kin.link_of, kin.qpos_adr, block.read, block.write, block.pick
    DRIVEN, MUSCLE, TENDON, SITE = spec.has("motor muscle tendon site")
    PULLED, transmission = MUSCLE or TENDON or SITE, transmission_law(spec) if TENDON or SITE else None
    NU, VADR, NBALL, FLOATING, FORCED = spec.nu, spec.dof0 - 1, spec.nball, spec.floating, spec.forced > 0
    VARIED, NPARAMETERS, THREADS_PER_ENV = spec.varied, spec.parameters, spec.threads_per_env

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
        if wp.static(NPARAMETERS > 0):
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
        if wp.static(NPARAMETERS > 0):
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

    return functions(locals())

"""One control step: all substeps of all environments in one launch.

On a GPU one thread or several simulate an environment (division.py). On a CPU one thread simulates a block (wide.py).

A substep is Featherstone's articulated-body algorithm (RBDA, Table 7.1) about the carrier's current position in world
axes, then semi-implicit Euler with the exact quaternion exponential. Its factorisation (U and 1/d of each joint, the
base's Cholesky factor) is what the paper caches as the factored mass matrix; the adjoint solves with it again.
"""

from functools import cache

import warp as wp

from diffsim.kernels.laws.force import external_force
from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.laws.muscle import muscle_law
from diffsim.kernels.mujoco.ground import contact_room, ground_contact
from diffsim.kernels.newton import newton_method
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.lane import lane_of
from diffsim.kernels.thread.model import types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import FAR, MAX_POSITION, MAX_SPEED, KernelSpec
from diffsim.kernels.thread.wide import blocks, module_options
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.link import link_law
from diffsim.kernels.tree.solve import DONE, FACTOR, NEWTON, SOLVE, articulated


@cache
def forward_kernel(spec: KernelSpec) -> wp.Kernel:
    t, sp, kin, sums, block = types(spec), spatial(spec), kinematics(spec), lane_sums(spec), blocks(spec)
    T, vec3, vec6, quat, lane = t.T, t.vec3, t.vec6, t.quat, lane_of(spec)
    Model, Lane, Ck, Load, Link, Motion = t.Model, t.Lane, t.Checkpoint, t.Load, t.Link, t.Motion
    Links, Motions, Loads, Quats, Root, Contact, Newton = (
        getattr(t, name) for name in "Links Motions Loads quats Root Contact Newton".split()
    )
    join, exp_quat, store, link_of, qpos_adr = sp.join, sp.exp_quat, kin.store, kin.link_of, kin.qpos_adr
    read, write, pick = block.read, block.write, block.pick
    link, force, joint = link_law(spec), external_force(spec), joint_law(spec)
    muscle, sweep, ground, newton = muscle_law(spec), articulated(spec), ground_contact(spec), newton_method(spec)
    PAIRS, BLOCKS, pairs = spec.pairs > 0, spec.pair_sizes.blocks, pair_rows(spec) if spec.pairs else None
    CONTACT, MOTOR, MUSCLE, TENDON, SITE, CHAIN = spec.has("contact motor muscle tendon site tendon_chain")
    transmission = transmission_law(spec) if TENDON or SITE else None
    NU, FLOATING, FORCED = spec.nu, spec.floating, spec.forced > 0
    CONSTRAINED, SOLVES, DAMPED = spec.constrained, spec.solves, spec.damped
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    NBALL = spec.nball
    NV, VADR = spec.nv, spec.dof0 - 1  # link i's joint in qvel is VADR + i
    THREADS_PER_ENV, SLOTS = spec.threads_per_env, spec.room
    # Local arrays have at least one element, also where they are not read.
    GROUND, BALLS, TENSIONS = contact_room(spec), max(NBALL, 1), NU if MUSCLE else 1
    CONTACTS = GROUND + BLOCKS

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
    def outward(m: Model, here: Lane, carrier: t.CarrierPos, links: Links, motions: Motions, loads: Loads):
        """Compute the links' velocity products, inertias and bias forces from their kinematics."""
        for i in range(1, here.n):
            turning = i
            if wp.static(NBALL > 0):
                turning = m.inboard[here.at + i]
            motions[i].C = wp.spatial_cross(links[turning].V, links[i].S * links[i].qd)
        for i in range(1, INERT + 1):
            loads[i] = Load()
        for i in range(FIRST, here.n):
            loads[i] = link.link_inertia(m, here, here.at + i, links[i], carrier)

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

    @wp.kernel(module="unique", module_options=module_options(spec))
    def forward(
        # model
        m: Model,
        first: int,  # block of this launch
        # options
        seconds: t.U,  # length of a substep
        substeps: int,
        passes: int,  # of Newton's method at most, read with constraints
        tolerance: t.U,  # of its residual, read with constraints
        # state in and out
        batch: t.Batch,
        # checkpoint out: rows row0 .. row0 + substeps - 1
        record: int,  # 1 if they are written
        row0: int,
        ck: t.Checkpoint,
        # out
        nonfinite: wp.array(dtype=wp.bool),
        unconverged: wp.array(dtype=int),
    ):
        here = lane(m, first, wp.tid(), T(seconds), batch.factors)
        links = wp.zeros(shape=SLOTS, dtype=Link)
        motions = wp.zeros(shape=SLOTS, dtype=Motion)
        loads = wp.zeros(shape=SLOTS, dtype=Load)
        ball_rot = wp.zeros(shape=BALLS, dtype=quat)
        tension = wp.zeros(shape=TENSIONS, dtype=T)
        if wp.static(MUSCLE):
            muscle.compute_tensions(m, here, batch.ctrl, tension)
        if wp.static(MOTOR and not TENDON):
            joint.motors_forward(m, here, batch.ctrl, motions)
        if wp.static(CONSTRAINED):
            free_loads = wp.zeros(shape=SLOTS, dtype=Load)  # without constraints
            contacts = wp.zeros(shape=CONTACTS, dtype=Contact)
            residual = T(0.0)
        root = read_state(m, here, batch, links, ball_rot)
        for sub in range(substeps):
            here.row = row0 + sub
            if record == 1:
                record_state(m, here, ck, links, ball_rot, root)
            # 1. outward: poses, velocities, velocity products, inertias and bias forces
            carrier = kin.carrier_position(m, T(0.0), T(0.0))
            if wp.static(FLOATING):
                links[0].R = wp.quat_to_matrix(root.rot)
                links[0].V = join(links[0].R * root.w, root.v)
                carrier = kin.carrier_position(m, root.pos[0], root.pos[2])
            if wp.static(NBALL > 0):
                kin.place_balls(m, here, ball_rot, links)
            carrier = kin.place_links(m, here, links, carrier)
            outward(m, here, carrier, links, motions, loads)
            if wp.static(FORCED):
                force.add_forces(m, here, batch.forces, links, loads)
            if wp.static(MUSCLE):
                muscle.add_muscles(m, here, tension, links, loads)
            if wp.static(TENDON):
                transmission.drive_forward(m, here, batch.ctrl, links, motions)
            if wp.static(SITE):
                transmission.add_sites(m, here, batch.ctrl, links, loads)
            # 2. inward and outward: articulated inertias, then accelerations. With constraints each pass is a step of
            # Newton's method (newton.py), and the adjoint uses the factor of the last iterate. MuJoCo's implicit
            # damping is one more solve: (M + h b) change = -h b a.
            if wp.static(CONSTRAINED):
                status = Newton()
                status.tolerance = T(tolerance)
                status.active = T(1.0)
                status.accel_sq = T(1.0)
                root.newton_vdot = vec3()
                root.newton_wdot = vec3()
                root.wdot = vec3()
                root.vdot = vec3()
                if wp.static(CONTACT):
                    here.contacts = ground.begin_contacts(m, here, links, carrier, motions, contacts)
                newton.initialize(m, here, links, motions, loads, free_loads, root)
                if wp.static(PAIRS):
                    here.begin = int(GROUND)
                    here.end = pairs.begin(m, here, links, motions, root.pos, contacts)
                phase = int(NEWTON)
                while phase < DONE:
                    if phase == NEWTON and (status.passes == passes or not block.any_of(status.active)):
                        residual = wp.max(residual, status.residual_sq)
                        phase = DONE - int(DAMPED)
                        if record == 1:
                            phase = FACTOR
                    if phase < DONE:
                        here.factor_row = SOLVES * here.row
                        if wp.static(DAMPED):
                            if phase == FACTOR:
                                here.factor_row = here.factor_row + 1
                        if phase == SOLVE:
                            for i in range(here.n):
                                loads[i] = free_loads[i]
                                loads[i].f = vec6()
                        else:
                            newton.linearize(m, here, motions, contacts, free_loads, loads)
                        here.store_factor = record * wp.where(phase > NEWTON, 1, 0)
                        sweep.inward(m, here, phase, ck, links, motions, loads)
                        root = sweep.accelerate(m, here, phase, ck, links, motions, loads[0], root)
                        if phase == NEWTON:
                            if wp.static(PAIRS):
                                root = pairs.correct_step(m, here, links, contacts, motions, root, status)
                            root, status = newton.newton_step(
                                m, here, links, free_loads, motions, contacts, root, status
                            )
                        else:
                            if wp.static(CHAIN):
                                if phase == SOLVE:
                                    root = transmission.correct_change(m, here, links, motions, root)
                            phase = phase + 1
                            if wp.static(not DAMPED):
                                phase = DONE
                for i in range(1, here.n):
                    change = motions[i].u
                    motions[i].u = motions[i].accel_joint
                    if wp.static(DAMPED):
                        motions[i].accel_joint = motions[i].accel_joint + change
                if record == 1:  # the acceleration before damping, at which the adjoint differentiates the constraints
                    record_accelerations(m, here, ck, NV, root.newton_vdot, root.newton_wdot, motions)
                    if wp.static(CONTACT):
                        ground.record_contacts(here, ck, contacts)
                    if wp.static(PAIRS):
                        pairs.record(here, ck, contacts)
                for i in range(1, here.n):
                    motions[i].u = motions[i].accel_joint
                if wp.static(not DAMPED):
                    root.vdot = vec3()
                    root.wdot = vec3()
                root.vdot = root.newton_vdot + root.vdot
                root.wdot = root.newton_wdot + root.wdot
            else:
                here.factor_row = here.row
                here.store_factor = record
                sweep.inward(m, here, SOLVE, ck, links, motions, loads)
                root = sweep.accelerate(m, here, SOLVE, ck, links, motions, loads[0], root)
            # 3. the new state
            if record == 1:
                record_accelerations(m, here, ck, 0, root.vdot, root.wdot, motions)
            root = integrate(m, here, links, motions, ball_rot, root)

        # An environment whose state is not finite or out of bounds gets back its state from before the step.
        failed = count_nonfinite(m, here, batch, links, ball_rot, root)
        block.write_flags(nonfinite, here.e, failed)
        if wp.static(CONSTRAINED):
            residual = pick(T(0.0), failed, T(0.0), wp.sqrt(residual))
            write(batch.qvel_out, here.e, NV, residual)
            if here.lane == 0:
                block.count(unconverged, here.e, pick(T(tolerance), residual, T(1.0), T(0.0)))
        write_state(m, here, failed, batch, links, ball_rot, root)

    return forward

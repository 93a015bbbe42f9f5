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
from diffsim.kernels.factors import lane_of
from diffsim.kernels.force import external_force
from diffsim.kernels.joint import joint_law
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.link import link_law
from diffsim.kernels.model import types
from diffsim.kernels.muscle import muscle_law
from diffsim.kernels.newton import newton_method
from diffsim.kernels.solve import DONE, FACTOR, NEWTON, SOLVE, articulated
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import FAR, MAX_PLACE, MAX_SPEED, KernelSpec
from diffsim.kernels.wide import blocks, module_options


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
    muscle, sweep, constraint, newton = muscle_law(spec), articulated(spec), constraint_law(spec), newton_method(spec)
    CONTACT, MOTOR, CLAMP, MUSCLE = spec.has("contact motor clamp muscle")
    NU, FLOATING, FORCED = spec.nu, spec.floating, spec.forced > 0
    CONSTRAINED, SOLVES, DAMPED = spec.constrained, spec.solves, spec.damped
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    NBALL, LIMIT = spec.nball, MAX_SPEED
    NV, VADR = spec.nv, spec.dof0 - 1  # link i's joint in qvel is VADR + i
    THREADS_PER_ENV, SLOTS = spec.threads_per_env, spec.slots
    SPHERES, BALLS, PULLS = max(spec.spheres, 1), max(NBALL, 1), NU if MUSCLE else 1  # no array has none

    @wp.func
    def state_of(m: Model, here: Lane, batch: t.Batch, links: Links, turn: Quats):
        """Into links and turn the joints' state; returns the floating base's."""
        e = here.e
        for i in range(1, here.n):
            links[i].q = read(batch.qpos, e, qpos_adr(m, here.at + i))
            links[i].qd = read(batch.qvel, e, VADR + link_of(m, here.at + i))
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                adr = qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b])
                turn[b] = wp.normalize(kin.load_quat(batch.qpos, e, adr))
        links[0].R = wp.identity(3, dtype=T)
        root = Root()
        if wp.static(FLOATING):
            root.pos = vec3(read(batch.qpos, e, 0), read(batch.qpos, e, 1), read(batch.qpos, e, 2))
            root.rot = wp.normalize(kin.load_quat(batch.qpos, e, 3))
            root.v = vec3(read(batch.qvel, e, 0), read(batch.qvel, e, 1), read(batch.qvel, e, 2))
            root.w = vec3(read(batch.qvel, e, 3), read(batch.qvel, e, 4), read(batch.qvel, e, 5))
        return root

    @wp.func
    def record_state(m: Model, here: Lane, ck: Ck, links: Links, turn: Quats, root: Root):
        """Into the checkpoint the state at the start of the substep."""
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
                store(ck.q, here.row, adr, e, turn[b][3])
                for k in range(3):
                    store(ck.q, here.row, adr + 1 + k, e, turn[b][k])

    @wp.func
    def record_rates(m: Model, here: Lane, ck: Ck, column: int, vdot: vec3, wdot: vec3, motions: Motions):
        """Into the checkpoint accelerations, from a column on: the base's, and those in motions' u."""
        if wp.static(FLOATING):
            for k in range(3):
                store(ck.a, here.row, column + k, here.e, vdot[k])
                store(ck.a, here.row, column + 3 + k, here.e, wdot[k])
        for i in range(1, here.n):
            store(ck.a, here.row, column + VADR + link_of(m, here.at + i), here.e, motions[i].u)

    @wp.func
    def outward(m: Model, here: Lane, place: t.Place, links: Links, motions: Motions, loads: Loads):
        """Velocity products, inertias and bias forces of links that are placed."""
        for i in range(1, here.n):
            turning = i
            if wp.static(NBALL > 0):
                turning = m.inboard[here.at + i]
            motions[i].C = wp.spatial_cross(links[turning].V, links[i].S * links[i].qd)
        for i in range(1, INERT + 1):
            loads[i] = Load()
        for i in range(FIRST, here.n):
            loads[i] = link.link_inertia(m, here, here.at + i, links[i], place)

    @wp.func
    def moved(place: T, rate: T, rest: T, h: T):
        """(The place after a substep, what rounding it lost so far), which is made good where the place is far off."""
        end = place + h * rate
        far = pick(T(FAR), wp.abs(end), T(1.0), T(0.0))
        if block.any_of(far):
            rest = far * (rest + (rate - (end - place) / h) * h)
            whole = end + rest
            rest = rest - (whole - end)
            end = pick(T(0.0), far, whole, end)
        return end, rest

    @wp.func
    def integrate(m: Model, here: Lane, links: Links, motions: Motions, turn: Quats, root: Root):
        h = here.h
        if wp.static(FLOATING):
            root.v = root.v + h * root.speeding_up
            root.w = root.w + h * root.turning_up
            for k in range(3):
                end, rest = moved(root.pos[k], root.v[k], root.rest[k], h)
                root.pos[k] = end
                root.rest[k] = rest
            root.rot = wp.normalize(root.rot * exp_quat(h * root.w))
        for i in range(1, here.n):
            links[i].qd = links[i].qd + h * motions[i].u
            end, rest = moved(links[i].q, links[i].qd, motions[i].rest, h)
            links[i].q = end
            motions[i].rest = rest
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                i = m.ball_slot[here.lane * NBALL + b]
                turn[b] = wp.normalize(turn[b] * exp_quat(h * vec3(links[i].qd, links[i + 1].qd, links[i + 2].qd)))
        return root

    @wp.func
    def too_fast(rate: T):
        """1 where a rate is beyond any imaginable one, or no number, else 0."""
        return pick(wp.abs(rate), T(LIMIT), T(0.0), T(1.0))

    @wp.func
    def too_far(place: T):
        """1 where a place is too far off for float32, or no number, else 0."""
        return pick(wp.abs(place), T(MAX_PLACE), T(0.0), T(1.0))

    @wp.func
    def no_turn(batch: t.Batch, here: Lane, adr: int):
        """1 where the square of a quaternion that came in is near the ends of float32, or no number, else 0."""
        given = kin.load_quat(batch.qpos, here.e, adr)
        square = wp.dot(given, given)
        return pick(T(1e-30), square, pick(square, T(1e30), T(0.0), T(1.0)), T(1.0))

    @wp.func
    def broken_numbers(m: Model, here: Lane, batch: t.Batch, links: Links, turn: Quats, root: Root):
        """How many numbers of the state left the finite ones, or any imaginable speed, or came in without direction."""
        broken = T(0.0)
        if wp.static(FLOATING):
            for k in range(3):
                broken = broken + too_far(root.pos[k]) + block.broken(root.rot[k])
                broken = broken + too_fast(root.v[k]) + too_fast(root.w[k])
            broken = broken + block.broken(root.rot[3]) + no_turn(batch, here, 3)
        for i in range(1, here.n):
            broken = broken + too_far(links[i].q) + too_fast(links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                broken = broken + no_turn(batch, here, qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b]))
                for k in range(4):
                    broken = broken + block.broken(turn[b][k])
        if wp.static(THREADS_PER_ENV > 1):
            broken = sums.add(broken)
        return broken

    @wp.func
    def hand_back(out: t.array2, start: t.array2, e: int, column: int, broken: T, value: T):
        """Writes the value, but what it was at the start to broken environments."""
        write(out, e, column, pick(T(0.0), broken, read(start, e, column), value))

    @wp.func
    def write_state(m: Model, here: Lane, broken: T, batch: t.Batch, links: Links, turn: Quats, root: Root):
        e = here.e
        if wp.static(FLOATING):
            for k in range(3):
                hand_back(batch.qpos_out, batch.qpos, e, k, broken, root.pos[k])
                hand_back(batch.qpos_out, batch.qpos, e, 4 + k, broken, root.rot[k])
                hand_back(batch.qvel_out, batch.qvel, e, k, broken, root.v[k])
                hand_back(batch.qvel_out, batch.qvel, e, 3 + k, broken, root.w[k])
            hand_back(batch.qpos_out, batch.qpos, e, 3, broken, root.rot[3])
        for i in range(1, here.n):
            hand_back(batch.qpos_out, batch.qpos, e, qpos_adr(m, here.at + i), broken, links[i].q)
            hand_back(batch.qvel_out, batch.qvel, e, VADR + link_of(m, here.at + i), broken, links[i].qd)
        if wp.static(NBALL > 0):
            for b in range(m.ball_count[here.lane]):
                adr = qpos_adr(m, here.at + m.ball_slot[here.lane * NBALL + b])
                hand_back(batch.qpos_out, batch.qpos, e, adr, broken, turn[b][3])
                for k in range(3):
                    hand_back(batch.qpos_out, batch.qpos, e, adr + 1 + k, broken, turn[b][k])

    @wp.kernel(module="unique", module_options=module_options(spec))
    def forward(
        # model
        m: Model,
        first: int,  # block of this launch
        seconds: t.U,  # of a substep
        substeps: int,
        passes: int,  # of Newton's method at most, and what it converges to: read with constraints
        tolerance: t.U,
        batch: t.Batch,
        # checkpoint out: rows row0 .. row0 + substeps - 1, written if record is 1
        record: int,
        row0: int,
        ck: t.Checkpoint,
        # out; with constraints the last column of qvel_out is the residual
        nonfinite: wp.array(dtype=wp.bool),
        unconverged: wp.array(dtype=int),
    ):
        here = lane(m, first, wp.tid(), T(seconds), batch.factors)
        links = wp.zeros(shape=SLOTS, dtype=Link)
        motions = wp.zeros(shape=SLOTS, dtype=Motion)
        loads = wp.zeros(shape=SLOTS, dtype=Load)
        turn = wp.zeros(shape=BALLS, dtype=quat)
        pull = wp.zeros(shape=PULLS, dtype=T)
        if wp.static(MUSCLE):
            muscle.activate(m, here, batch.ctrl, pull)
        if wp.static(MOTOR):
            joint.drive(m, here, batch.ctrl, motions)
        if wp.static(CONSTRAINED):
            free = wp.zeros(shape=SLOTS, dtype=Load)  # without constraints
            touches = wp.zeros(shape=SPHERES, dtype=Contact)
            residual = T(0.0)
        root = state_of(m, here, batch, links, turn)
        for sub in range(substeps):
            here.row = row0 + sub
            if record == 1:
                record_state(m, here, ck, links, turn, root)
            # 1. outward: poses, velocities, velocity products, inertias and bias forces
            place = kin.carrier_place(m, T(0.0), T(0.0))
            if wp.static(FLOATING):
                links[0].R = wp.quat_to_matrix(root.rot)
                links[0].V = join(links[0].R * root.w, root.v)
                place = kin.carrier_place(m, root.pos[0], root.pos[2])
            if wp.static(NBALL > 0):
                kin.place_balls(m, here, turn, links)
            place = kin.place_links(m, here, links, place)
            outward(m, here, place, links, motions, loads)
            if wp.static(FORCED):
                force.add_forces(m, here, batch.forces, links, loads)
            if wp.static(MUSCLE):
                muscle.add_muscles(m, here, pull, links, loads)
            # 2. inward and outward: articulated inertias, then accelerations. With constraints each pass is a step of
            # Newton's method (newton.py); the adjoint has the factor where it ends. MuJoCo's
            # implicit damping is one solve more: (M + h b) change = -h b a.
            if wp.static(CONSTRAINED):
                by = Newton()
                by.tolerance = T(tolerance)
                by.going = T(1.0)
                by.size = T(1.0)
                root.vdot = vec3()
                root.wdot = vec3()
                root.turning_up = vec3()
                root.speeding_up = vec3()
                if wp.static(CONTACT):
                    constraint.touch(m, here, links, place, touches)
                newton.begin(m, here, links, motions, loads, free, root)
                phase = int(NEWTON)
                while phase < DONE:
                    if phase == NEWTON and (by.passes == passes or not block.any_of(by.going)):
                        residual = wp.max(residual, by.off)
                        phase = DONE - int(DAMPED)
                        if record == 1:
                            phase = FACTOR
                    if phase < DONE:
                        here.factor = SOLVES * here.row
                        if wp.static(DAMPED):
                            if phase == FACTOR:
                                here.factor = here.factor + 1
                        if phase == SOLVE:
                            for i in range(here.n):
                                loads[i] = free[i]
                                loads[i].f = vec6()
                        else:
                            newton.linearize(m, here, motions, touches, free, loads)
                        here.keep = record * wp.where(phase > NEWTON, 1, 0)
                        sweep.inward(m, here, phase, ck, links, motions, loads)
                        root = sweep.accelerate(m, here, phase, ck, links, motions, loads[0], root)
                        if phase == NEWTON:
                            root, by = newton.step_on(m, here, links, motions, touches, free, root, by)
                        else:
                            phase = phase + 1
                            if wp.static(not DAMPED):
                                phase = DONE
                for i in range(1, here.n):
                    change = motions[i].u
                    motions[i].u = motions[i].rate
                    if wp.static(DAMPED):
                        motions[i].rate = motions[i].rate + change
                if record == 1:  # the acceleration of the constraints, of which the adjoint is
                    record_rates(m, here, ck, NV, root.vdot, root.wdot, motions)
                    if wp.static(CONTACT):
                        constraint.record_contacts(m, here, ck, touches)
                for i in range(1, here.n):
                    motions[i].u = motions[i].rate
                if wp.static(not DAMPED):
                    root.speeding_up = vec3()
                    root.turning_up = vec3()
                root.speeding_up = root.vdot + root.speeding_up
                root.turning_up = root.wdot + root.turning_up
            else:
                here.factor = here.row
                here.keep = record
                sweep.inward(m, here, SOLVE, ck, links, motions, loads)
                root = sweep.accelerate(m, here, SOLVE, ck, links, motions, loads[0], root)
            # 3. the new state
            if record == 1:
                record_rates(m, here, ck, 0, root.speeding_up, root.turning_up, motions)
            root = integrate(m, here, links, motions, turn, root)

        # An environment that left the finite numbers, or any imaginable speed, is handed back as it came.
        broken = broken_numbers(m, here, batch, links, turn, root)
        block.write_flags(nonfinite, here.e, broken)
        if wp.static(CONSTRAINED):
            residual = pick(T(0.0), broken, T(0.0), wp.sqrt(residual))
            write(batch.qvel_out, here.e, NV, residual)
            if here.lane == 0:
                block.count(unconverged, here.e, pick(T(tolerance), residual, T(1.0), T(0.0)))
        write_state(m, here, broken, batch, links, turn, root)

    return forward

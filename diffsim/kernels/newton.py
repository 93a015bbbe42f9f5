"""Newton's method on MuJoCo's constraints.

A pass of the articulated-body algorithm linearises the constraints' forces about the iterate: after the step s they are
f - H s. The iterate is the solution if the true forces f(s) equal that (line_search.py).

A pass solves for the step, not for its end: on stiff ground float32 rounds away the part of a whole acceleration on
which the force depends. So jar and the links' accelerations are sums of steps, which become small.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.gyroscope import gyroscope
from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.line_search import step_length
from diffsim.kernels.mujoco.ground import contact_room, ground_contact
from diffsim.kernels.mujoco.limits import joint_limits
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.state import state_access
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.solve import DONE, FACTOR, NEWTON, SOLVE, articulated


@cache
def newton_iterate(spec: KernelSpec) -> SimpleNamespace:
    """Make the iterate: its start, its loads, and its Newton step after a pass."""
    t, sums, block, join = types(spec), lane_sums(spec), blocks(spec), spatial(spec).join
    T, vec3, Model, Lane, pick = t.T, t.vec3, t.Model, t.Lane, block.pick
    Links, Motions, Loads, Root, Newton = t.Links, t.Motions, t.Loads, t.Root, t.Newton
    joint, ground, limits, search = joint_law(spec), ground_contact(spec), joint_limits(spec), step_length(spec)
    PAIRS, pairs = spec.pairs > 0, pair_rows(spec) if spec.pairs else None
    CONTACT, LIMIT, LOSS = spec.has("contact limit frictionloss")
    FLOATING, SHARED, JOINT_ROWS = spec.floating, spec.threads_per_env > 1, LIMIT or LOSS
    FIRST, ROOM = 0 if FLOATING else 1 + spec.inert, contact_room(spec)  # the first link with inertia

    @wp.func
    def initialize(m: Model, here: Lane, links: Links, motions: Motions, loads: Loads, free_loads: Loads, root: Root):
        """Set the iterate to zero acceleration, with limits that act as if each joint moved into its own."""
        motions[0].accel_link = join(vec3(), -vec3(m.gravity) - wp.cross(wp.spatial_top(links[0].V), root.v))
        for i in range(here.n):
            k = here.at + i
            free_loads[i] = loads[i]
            motions[i].accel_joint = T(0.0)
            if i > 0:
                q = links[i].q
                qd = links[i].qd
                motions[i].accel_link = motions[m.parent[k]].accel_link + motions[i].C
                motions[i].free_force = joint.force(m, here, k, motions[i].motor, q, qd)
                if wp.static(LIMIT):
                    motions[i].limit = limits.limit_state(m, here, k, q, qd)
                if wp.static(JOINT_ROWS):
                    con = limits.joint_constraint(m, k, motions[i].limit, qd, T(0.0), T(1.0))
                    motions[i].con_force = con[0]
                    motions[i].con_slope = con[1]

    @wp.func
    def linearize(m: Model, here: Lane, motions: Motions, contacts: t.Contacts, free_loads: Loads, loads: Loads):
        """Compute the iterate's loads, contacts included: their imbalance with joint forces gives the next step."""
        for i in range(here.n):
            load = free_loads[i]
            a = wp.spatial_top(motions[i].accel_link)
            l = wp.spatial_bottom(motions[i].accel_link)
            load.f = load.f + join(load.a * a + load.b * l, a * load.b + load.d * l)
            if wp.static(CONTACT):
                if i >= FIRST:
                    load = ground.add_contacts(motions[i].contacts_begin, motions[i].contacts_end, contacts, load)
            loads[i] = load
        if wp.static(PAIRS):
            pairs.add_forces(m, here, contacts, motions, loads)

    @wp.func
    def newton_step(
        # model
        m: Model,
        here: Lane,
        # kinematics and inertia in
        links: Links,
        free_loads: Loads,
        # iterate and trial step, in and out
        motions: Motions,
        contacts: t.Contacts,
        root: Root,
        status: Newton,
    ):
        """Move the iterate by a Newton step, joints' u and links' A, in the environments that are active."""
        status.accel_sq = T(0.0)
        step_sq = T(0.0)
        for r in range(6):
            motions[0].A[r] = pick(T(0.0), status.active, motions[0].A[r], T(0.0))
        if wp.static(FLOATING):
            for k in range(3):
                root.wdot[k] = pick(T(0.0), status.active, root.wdot[k], T(0.0))
                root.vdot[k] = pick(T(0.0), status.active, root.vdot[k], T(0.0))
            status.accel_sq = wp.length_sq(root.newton_wdot + root.wdot) + wp.length_sq(root.newton_vdot + root.vdot)
            step_sq = wp.length_sq(root.wdot) + wp.length_sq(root.vdot)
            status.accel_sq = T(m.owned[here.at]) * status.accel_sq
            step_sq = T(m.owned[here.at]) * step_sq
        for i in range(1, here.n):
            step = pick(T(0.0), status.active, motions[i].u, T(0.0))
            accel = motions[i].accel_joint + step
            motions[i].u = step
            motions[i].A = motions[m.parent[here.at + i]].A + links[i].S * step
            status.accel_sq = status.accel_sq + T(m.owned[here.at + i]) * accel * accel
            step_sq = step_sq + T(m.owned[here.at + i]) * step * step
        if wp.static(SHARED):
            status.accel_sq = sums.add(status.accel_sq)
            step_sq = sums.add(step_sq)
        status.accel_sq = status.accel_sq + T(1.0)
        alpha, status = search.line_search(m, here, links, free_loads, motions, contacts, step_sq, status)
        if wp.static(FLOATING):
            root.newton_wdot = root.newton_wdot + alpha * root.wdot
            root.newton_vdot = root.newton_vdot + alpha * root.vdot
        for i in range(here.n):
            motions[i].accel_joint = motions[i].accel_joint + alpha * motions[i].u
            motions[i].accel_link = motions[i].accel_link + alpha * motions[i].A
            motions[i].con_force = motions[i].trial_force
            motions[i].con_slope = motions[i].trial_slope
        if wp.static(CONTACT):
            ground.accept_contacts(0, wp.min(here.contacts, ROOM), contacts)
        if wp.static(PAIRS):
            ground.accept_contacts(here.begin, here.end, contacts)
        status.passes = status.passes + 1
        return root, status

    return functions(locals())


@cache
def newton_method(spec: KernelSpec) -> SimpleNamespace:
    """Make the accelerations of a substep with constraints."""
    t, block, iterate, sweep = types(spec), blocks(spec), newton_iterate(spec), articulated(spec)
    T, vec3, vec6, Model, Lane, Ck = t.T, t.vec3, t.vec6, t.Model, t.Lane, t.Checkpoint
    Links, Motions, Loads, Root, Newton, Contacts = t.Links, t.Motions, t.Loads, t.Root, t.Newton, t.Contacts
    ground, state, pairs = ground_contact(spec), state_access(spec), pair_rows(spec) if spec.pairs else None
    CONTACT, CHAIN, GYROSCOPIC = spec.has("contact tendon_chain gyroscopic")
    transmission, gyro = transmission_law(spec) if CHAIN else None, gyroscope(spec) if GYROSCOPIC else None
    PAIRS, DAMPED, ROOM, NV, SOLVES = spec.pairs > 0, spec.damped, contact_room(spec), spec.nv, spec.solves

    @wp.func
    def set_loads(
        m: Model, here: Lane, phase: int, motions: Motions, contacts: Contacts, free_loads: Loads, loads: Loads
    ):
        """Set the loads of a phase's pass: the iterate's, or for SOLVE inertias alone."""
        if phase == SOLVE:
            for i in range(here.n):
                loads[i] = free_loads[i]
                loads[i].f = vec6()
        else:
            iterate.linearize(m, here, motions, contacts, free_loads, loads)

    @wp.func
    def finish(m: Model, here: Lane, record: int, ck: Ck, motions: Motions, contacts: Contacts, root: Root):
        """Set the accelerations, joints' into u, to the iterate's plus the change by damping; returns the base.

        The checkpoint gets those before damping, at which the adjoint differentiates the constraints.
        """
        for i in range(1, here.n):
            change = motions[i].u
            motions[i].u = motions[i].accel_joint
            if wp.static(DAMPED):
                motions[i].accel_joint = motions[i].accel_joint + change
        if record == 1:
            state.record_accelerations(m, here, ck, NV, root.newton_vdot, root.newton_wdot, motions)
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
        return root

    @wp.func
    def accelerate(
        # model
        m: Model,
        here: Lane,
        # options
        passes: int,  # at most
        tolerance: T,
        # kinematics, and loads without constraints in
        links: Links,
        carrier: t.CarrierPos,
        loads: Loads,
        # accelerations out
        motions: Motions,
        root: Root,
        # work
        free_loads: Loads,
        contacts: Contacts,  # of the last substep in
        # checkpoint out
        record: int,  # 1 if it is written
        ck: Ck,
    ):
        """Compute a substep's accelerations with constraints, those of joints into motions' u.

        NEWTON passes until the iterate has converged. FACTOR writes the factor about the last iterate for the adjoint,
        if that is recorded. SOLVE takes MuJoCo's implicit damping, (M + h b) change = -h b a. All phases share one loop
        and so one call of the sweep: a compiler would write out each call, and the kernel be three times as long.

        Returns:
            the lane, with the number of its contacts; the base; the square of the residual.
        """
        status = Newton()
        status.tolerance = tolerance
        status.active = T(1.0)
        status.accel_sq = T(1.0)
        root.newton_vdot = vec3()
        root.newton_wdot = vec3()
        root.wdot = vec3()
        root.vdot = vec3()
        if wp.static(CONTACT):
            here.contacts = ground.begin_contacts(m, here, links, carrier, motions, contacts)
        iterate.initialize(m, here, links, motions, loads, free_loads, root)
        if wp.static(PAIRS):
            here.begin = int(ROOM)
            here.end = pairs.begin(m, here, links, motions, root.pos, contacts)
        phase = int(NEWTON)
        while phase < DONE:
            if phase == NEWTON and (status.passes == passes or not block.any_of(status.active)):
                phase = DONE - int(DAMPED)
                if record == 1:
                    phase = FACTOR
            if phase < DONE:
                here.factor_row = SOLVES * here.row
                if wp.static(DAMPED):
                    if phase == FACTOR:
                        here.factor_row = here.factor_row + 1
                here.store_factor = record * wp.where(phase > NEWTON, 1, 0)
                set_loads(m, here, phase, motions, contacts, free_loads, loads)
                sweep.inward(m, here, phase, ck, links, motions, loads)
                root = sweep.accelerate(m, here, phase, ck, links, motions, loads[0], root)
                if phase == NEWTON:
                    if wp.static(PAIRS):
                        root = pairs.correct_step(m, here, links, contacts, motions, root, status)
                    root, status = iterate.newton_step(m, here, links, free_loads, motions, contacts, root, status)
                else:
                    if wp.static(CHAIN):
                        if phase == SOLVE:
                            root = transmission.correct_change(m, here, links, motions, root)
                    if wp.static(GYROSCOPIC):
                        if phase == SOLVE:
                            root = gyro.correct_change(m, here, links, motions, root)
                    phase = phase + 1
                    if wp.static(not DAMPED):
                        phase = DONE
        root = finish(m, here, record, ck, motions, contacts, root)
        return here, root, status.residual_sq

    return functions(locals())

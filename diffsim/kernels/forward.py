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
from diffsim.kernels.mujoco.ground import contact_room
from diffsim.kernels.newton import newton_method
from diffsim.kernels.state import state_access
from diffsim.kernels.thread.lane import lane_of
from diffsim.kernels.thread.model import types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks, module_options
from diffsim.kernels.transmission import transmission_law
from diffsim.kernels.tree.integrator import integrator
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.link import link_law
from diffsim.kernels.tree.solve import SOLVE, articulated


@cache
def forward_kernel(spec: KernelSpec) -> wp.Kernel:
    """Make the kernel that steps the environments of a specification."""
    t, kin, block, lane, join = types(spec), kinematics(spec), blocks(spec), lane_of(spec), spatial(spec).join
    T, quat, Model, pick = t.T, t.quat, t.Model, block.pick
    Load, Link, Motion, Contact = t.Load, t.Link, t.Motion, t.Contact
    link, joint, force, muscle = link_law(spec), joint_law(spec), external_force(spec), muscle_law(spec)
    state, sweep, euler, newton = state_access(spec), articulated(spec), integrator(spec), newton_method(spec)
    MOTOR, MUSCLE, TENDON, SITE = spec.has("motor muscle tendon site")
    transmission = transmission_law(spec) if TENDON or SITE else None
    FLOATING, FORCED, CONSTRAINED = spec.floating, spec.forced > 0, spec.constrained
    NV, NBALL, SLOTS = spec.nv, spec.nball, spec.room
    # Local arrays have at least one element, also where they are not read.
    CONTACTS, BALLS = contact_room(spec) + spec.pair_sizes.blocks, max(NBALL, 1)
    TENSIONS = spec.nu if MUSCLE else 1

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
        """Take a control step of the environments of this launch."""
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
        root = state.read_state(m, here, batch, links, ball_rot)
        for sub in range(substeps):
            here.row = row0 + sub
            if record == 1:
                state.record_state(m, here, ck, links, ball_rot, root)
            # 1. outward: poses, velocities, velocity products, inertias and bias forces
            carrier = kin.carrier_position(m, T(0.0), T(0.0))
            if wp.static(FLOATING):
                links[0].R = wp.quat_to_matrix(root.rot)
                links[0].V = join(links[0].R * root.w, root.v)
                carrier = kin.carrier_position(m, root.pos[0], root.pos[2])
            if wp.static(NBALL > 0):
                kin.place_balls(m, here, ball_rot, links)
            carrier = kin.place_links(m, here, links, carrier)
            link.outward(m, here, carrier, links, motions, loads)
            if wp.static(FORCED):
                force.add_forces(m, here, batch.forces, links, loads)
            if wp.static(MUSCLE):
                muscle.add_muscles(m, here, tension, links, loads)
            if wp.static(TENDON):
                transmission.drive_forward(m, here, batch.ctrl, links, motions)
            if wp.static(SITE):
                transmission.add_sites(m, here, batch.ctrl, links, loads)
            # 2. inward and outward: articulated inertias, then accelerations. With constraints each pass is a step of
            # Newton's method.
            if wp.static(CONSTRAINED):
                here, root, residual_sq = newton.accelerate(
                    m,
                    here,
                    passes,
                    T(tolerance),
                    links,
                    carrier,
                    loads,
                    motions,
                    root,
                    free_loads,
                    contacts,
                    record,
                    ck,
                )
                residual = wp.max(residual, residual_sq)
            else:
                here.factor_row = here.row
                here.store_factor = record
                sweep.inward(m, here, SOLVE, ck, links, motions, loads)
                root = sweep.accelerate(m, here, SOLVE, ck, links, motions, loads[0], root)
            # 3. the new state
            if record == 1:
                state.record_accelerations(m, here, ck, 0, root.vdot, root.wdot, motions)
            root = euler.integrate(m, here, links, motions, ball_rot, root)

        # An environment whose state is not finite or out of bounds gets back its state from before the step.
        failed = state.count_nonfinite(m, here, batch, links, ball_rot, root)
        block.write_flags(nonfinite, here.e, failed)
        if wp.static(CONSTRAINED):
            residual = pick(T(0.0), failed, T(0.0), wp.sqrt(residual))
            block.write(batch.qvel_out, here.e, NV, residual)
            if here.lane == 0:
                block.count(unconverged, here.e, pick(T(tolerance), residual, T(1.0), T(0.0)))
        state.write_state(m, here, failed, batch, links, ball_rot, root)

    return forward

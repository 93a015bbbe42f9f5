"""Rows of MuJoCo's constraints between two bodies: equality and contacts. adjoint.py has their adjoint.

A row has J a of the links' accelerations (jacobian.py). Its force acts on both links, so
Newton's matrix leaves the tree, and conjugate gradients take part in each pass (solver.py). They find the change
of the rows' forces, which takes the place of -H s in the line search (newton.py). So that one accounts for their error.

Equality has the force -D jar whatever its sign. Impedance and stiffness are those of the norm of its violation, which
the two blocks of a weld share (MuJoCo's mj_instantiateEquality and mj_makeImpedance). Contacts of two geoms have the
law of the ground's (ground.py). The blocks that act are listed in each substep: without any, no time is spent.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.cone import elliptic_cone, pyramidal_cone
from diffsim.kernels.mujoco.ground import pair_column
from diffsim.kernels.mujoco.impedance import impedance_law
from diffsim.kernels.pairs.equality import equality_rows
from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.pairs.listing import pair_list
from diffsim.kernels.pairs.solver import row_solver
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.robot.types import GEOMS, JOINT

# Accuracy of a Newton step: its residual in multiples of the iterate's, in the norm of T^-1. Where rows are of very
# different stiffness, as those of slippery pyramids, the stiffest ones are nearly all of that norm, and a step of that
# accuracy is wrong in all others: after the first LOOSE passes it is ten times higher in each.
ACCURACY, LOOSE, FINEST = 1e-2, 4, 1e-12


@cache
def pair_rows(spec: KernelSpec) -> SimpleNamespace:
    """Make the rows' part of Newton's method."""
    t, block, kin, J, equality = types(spec), blocks(spec), kinematics(spec), pair_jacobian(spec), equality_rows(spec)
    solver, sp, constraint = row_solver(spec, "Motions"), spatial(spec), impedance_law(spec)
    T, vec3, vec4, vec6, pick, join = t.T, t.vec3, t.vec4, t.vec6, block.pick, sp.join
    Model, Lane, Ck, Links, Contacts, Motions, Loads, Root, Newton = (
        getattr(t, name) for name in "Model Lane Checkpoint Links Contacts Motions Loads Root Newton".split()
    )
    FLOATING, VARIED, WORLD = spec.floating, spec.varied, spec.room - 1
    listed, LAST = pair_list(spec, False), spec.pair_sizes.last
    cone = pyramidal_cone(spec) if "pyramid" in spec.features else elliptic_cone(spec)
    COLUMN = pair_column(spec)  # of jar in the checkpoint
    JOINTS, TOUCH = spec.has("joint_rows geoms_rows")

    @wp.func
    def equality_state(m: Model, s: int, r: vec3):
        """Return D, its derivative by the norm of the violation, and k d and that of it; r is the block's own part."""
        params = m.row_params[s]
        state = constraint.impedance_row(params, T(1.0), -wp.length(r))
        Dw = state[0] * T(params[4])
        d = Dw / (T(1.0) + Dw)
        k = T(params[0])
        return vec4(state[0], -state[0] * state[1], k * d, -k * d * state[1] / (T(1.0) + Dw))

    @wp.func
    def norm_of(m: Model, s: int, links: Links):
        """Return the block's violation, and the norm of that of its constraint as a vector along x."""
        r = equality.violation(m, s, links)
        partner = m.row_partner[s]
        if partner == s:
            return r, r
        other = equality.violation(m, partner, links)
        return r, vec3(wp.sqrt(wp.dot(r, r) + wp.dot(other, other)), T(0.0), T(0.0))

    @wp.func
    def constants(m: Model, here: Lane, s: int):
        """Return a block's factor of k, its b and its friction; factors of the environment are those of geoms."""
        params = m.row_params[s]
        result = vec3(T(1.0), T(params[1]), T(params[2]))
        if wp.static(VARIED):
            if m.row_kind[s] == GEOMS:
                result = vec3(here.k_n, wp.sqrt(here.k_n) * T(params[1]), here.mu * T(params[2]))
        return result

    @wp.func
    def law(m: Model, here: Lane, s: int, D: T, jar: vec3, sticking: T):
        """Return the force of the rows, and H, minus its derivatives in jar; sticking as in cone.py."""
        H = D * wp.identity(3, dtype=T)
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                H = wp.diag(vec3(D, T(0.0), T(0.0)))
        f = -(H * jar)
        if wp.static(TOUCH):
            if m.row_kind[s] == GEOMS:
                f, H = cone.force(D, constants(m, here, s)[2], T(m.row_params[s][3]), jar, sticking)
        return f, H

    @wp.func
    def geoms_state(m: Model, here: Lane, c: int, contacts: Contacts):
        """Return the impedance_row of two geoms, with D = 0 beyond the margin."""
        s = contacts[c].row
        stiffness = constants(m, here, s)[0]
        state = constraint.impedance_row(m.row_params[s], stiffness, wp.min(contacts[c].r, T(0.0)))
        D = contacts[c].active * state[0]
        if wp.static(VARIED):
            D = here.k_d * D
        return vec4(D, state[1], state[2], state[3])

    @wp.func
    def rest_of(m: Model, here: Lane, c: int, links: Links, contacts: Contacts):
        """Return D of a block, and jar without velocity and acceleration."""
        s = contacts[c].row
        D = T(0.0)
        rest = vec3()
        if m.row_kind[s] == GEOMS:
            state = geoms_state(m, here, c, contacts)
            D = state[0]
            rest[2] = state[2]
        else:
            r, norm = norm_of(m, s, links)
            state = equality_state(m, s, norm)
            D = state[0]
            rest = state[2] * r
        return D, rest

    @wp.func
    def begin(m: Model, here: Lane, links: Links, motions: Motions, origin: vec3, contacts: Contacts):
        """Set up the blocks at the start of a substep, with zero acceleration; returns their end."""
        listed.place_world(links, origin)
        motions[WORLD].accel_link = join(vec3(), -vec3(m.gravity))
        solver.clear(motions)
        end = listed.list_blocks(m, here, links, contacts)
        for c in range(here.begin, end):
            s = contacts[c].row
            i, j = J.ends(m, s)
            D, rest = rest_of(m, here, c, links, contacts)
            velocity = J.rates(m, c, contacts, links[i].V, links[j].V, links[i].qd, links[j].qd)
            jar = constants(m, here, s)[1] * velocity + rest
            jar = jar + equality.drift(m, c, links, contacts, motions[i].accel_link, motions[j].accel_link)
            f, H = law(m, here, s, D, jar, T(1.0))
            contacts[c].D = D
            contacts[c].jar = jar
            contacts[c].f = f
            contacts[c].H = H
        return end

    @wp.func
    def add_forces(m: Model, here: Lane, contacts: Contacts, motions: Motions, loads: Loads):
        """Add the iterate's forces to the links' loads, and those on joints to the joints' rate."""
        if here.end > here.begin:
            solver.clear(motions)
            for c in range(here.begin, here.end):
                solver.spread(m, c, contacts, contacts[c].f, motions)
            for i in range(here.n):
                loads[i].f = loads[i].f + motions[i].twist

    @wp.func
    def correct_step(
        m: Model, here: Lane, links: Links, contacts: Contacts, motions: Motions, root: Root, status: Newton
    ):
        """Turn the tree's Newton step into that with the rows between bodies."""
        if here.end > here.begin:
            for c in range(here.begin, here.end):
                i, j = J.ends(m, contacts[c].row)
                A, B = motions[i].A, motions[j].A
                contacts[c].rate = J.rates(m, c, contacts, A, B, motions[i].u, motions[j].u)
            accuracy = wp.max(ACCURACY * wp.pow(0.1, wp.max(float(status.passes + 1 - LOOSE), 0.0)), FINEST)
            solver.solve(m, here, links, contacts, motions, root.L, status.active, T(accuracy))
            for c in range(here.begin, here.end):
                contacts[c].Hs = -contacts[c].change
            motions[0].A = motions[0].A + motions[0].twist
            if wp.static(FLOATING):
                root.wdot = root.wdot + wp.transpose(links[0].R) * wp.spatial_top(motions[0].twist)
                root.vdot = root.vdot + wp.spatial_bottom(motions[0].twist)
            for i in range(1, here.n):
                motions[i].u = motions[i].u + motions[i].rate
                motions[i].A = motions[m.parent[i]].A + links[i].S * motions[i].u
        return root

    @wp.func
    def trial(m: Model, here: Lane, motions: Motions, alpha: T, contacts: Contacts):
        """Evaluate the rows after the trial step alpha s; returns their Trial."""
        total = t.Trial()
        total.error_sq = contacts[here.begin + LAST].D  # no solution where a contact has no room
        for c in range(here.begin, here.end):
            s = contacts[c].row
            i, j = J.ends(m, s)
            step_jar = J.rates(m, c, contacts, motions[i].A, motions[j].A, motions[i].u, motions[j].u)
            jar = contacts[c].jar + alpha * step_jar
            f, H = law(m, here, s, contacts[c].D, jar, T(0.0))
            force_error = contacts[c].f - alpha * contacts[c].Hs - f
            w = T(m.row_params[s][4])
            accel_error = constraint.acceleration_for(force_error, w, H)
            total.slope = total.slope + wp.dot(step_jar, force_error)
            total.linear = total.linear + wp.dot(step_jar, contacts[c].Hs)
            total.curvature = total.curvature + wp.dot(step_jar, H * step_jar)
            total.error_sq = total.error_sq + wp.dot(accel_error, accel_error)
            total.stiffness = total.stiffness + w * wp.trace(H)
            contacts[c].trial_jar = jar
            contacts[c].trial_force = f
            contacts[c].H = H
        return total

    @wp.func
    def record(here: Lane, ck: Ck, contacts: Contacts):
        """Store jar of the blocks in the checkpoint."""
        for c in range(here.begin, here.end):
            for r in range(3):
                kin.store(ck.a, here.row, COLUMN + 3 * contacts[c].row + r, here.e, contacts[c].jar[r])

    return functions(locals())

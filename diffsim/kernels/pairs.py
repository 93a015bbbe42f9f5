"""Rows of MuJoCo's constraints between two bodies, and their adjoint: equality constraints and contacts.

A row has J a = E' (A_j - A_i) of the links' accelerations (pair_geometry.py). Its force acts on both links, so
Newton's matrix leaves the tree, and conjugate gradients take part in each pass (pair_solver.py). They find the change
of the rows' forces, which takes the place of -H s in the line search (newton.py). So that one accounts for their error.

Equality has the force -D jar whatever its sign. Impedance and stiffness are those of the norm of its violation, which
the two blocks of a weld share (MuJoCo's mj_instantiateEquality and mj_makeImpedance). Contacts of two geoms have the
law of the ground's (constraint.py). The blocks that act are listed in each substep: without any, no time is spent.

The adjoint begins at phi = -f . rate with rate the rows' velocity under lambda, as for contacts (constraint.py).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.cone import elliptic_cone, pyramidal_cone
from diffsim.kernels.constraint import constraint_law
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.model import functions, types
from diffsim.kernels.pair_geometry import pair_geometry
from diffsim.kernels.pair_solver import row_solver
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks
from diffsim.robot.pairs import GEOMS, JOINT, POINT, TURN

ACCURACY = 1e-2  # of a Newton step: of its residual, in multiples of the iterate's, in the norm of T^-1
ACCURACY_ADJOINT = 1e-12, 1e-6  # the same of the adjoint's solve, in float64 and in float32
SMALLEST = 1e-12  # of a violation whose direction is defined
UNSOLVED = 1e8  # square of the acceleration by which a step is wrong that lacks a contact for want of room


@cache
def pair_rows(spec: KernelSpec) -> SimpleNamespace:
    """Make the rows' part of Newton's method and of the adjoint."""
    t, sp, block, kin, geometry = types(spec), spatial(spec), blocks(spec), kinematics(spec), pair_geometry(spec)
    forward, backward, constraint = row_solver(spec, "Motions"), row_solver(spec, "Nodes"), constraint_law(spec)
    T, vec3, vec4, vec6, mat3, mat6, pick, join = t.T, t.vec3, t.vec4, t.vec6, t.mat3, t.mat6, block.pick, sp.join
    Model, Lane, Ck, Links, Contacts, Motions, Loads = (
        getattr(t, name) for name in "Model Lane Checkpoint Links Contacts Motions Loads".split()
    )
    Nodes, Adjoints, Root, Newton, force_at = t.Nodes, t.Adjoints, t.Root, t.Newton, sp.force_at
    FLOATING, NV, SOLVES, PAIRS, WORLD = spec.floating, spec.nv, spec.solves, spec.pairs, spec.room - 1
    EQUALITIES, NPOINTS, LAST = spec.pair_sizes.equalities, spec.pair_sizes.points, spec.pair_sizes.blocks - 1
    cone = pyramidal_cone(spec) if "pyramid" in spec.features else elliptic_cone(spec)
    COLUMN = 2 * NV + 3 * spec.spheres  # of jar in the checkpoint
    BASE, VADR = 7 * (spec.nlink - 1), spec.dof0 - 1
    JOINTS, POINTS, TURNS, TOUCH = spec.has("joint_rows point_rows turn_rows geoms_rows")
    ENOUGH = ACCURACY_ADJOINT[int(t.U == wp.float32)]

    @wp.func
    def place_world(links: Links, origin: vec3):
        """Place the world, beside a floating base about which all else is."""
        if wp.static(FLOATING):
            links[WORLD].R = wp.identity(3, dtype=T)
            links[WORLD].x = -origin

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
        r = geometry.violation(m, s, links)
        partner = m.row_partner[s]
        if partner == s:
            return r, r
        other = geometry.violation(m, partner, links)
        return r, vec3(wp.sqrt(wp.dot(r, r) + wp.dot(other, other)), T(0.0), T(0.0))

    @wp.func
    def law(m: Model, s: int, D: T, jar: vec3, sticking: T):
        """Return the force of the rows, and H, minus its derivatives in jar; sticking as in cone.py."""
        H = D * wp.identity(3, dtype=T)
        if wp.static(JOINTS):
            if m.row_kind[s] == JOINT:
                H = wp.diag(vec3(D, T(0.0), T(0.0)))
        f = -(H * jar)
        if wp.static(TOUCH):
            if m.row_kind[s] == GEOMS:
                f, H = cone.force(D, T(m.row_params[s][2]), T(m.row_params[s][3]), jar, sticking)
        return f, H

    @wp.func
    def geoms_state(m: Model, c: int, contacts: Contacts):
        """Return the impedance_row of two geoms, with D = 0 beyond the margin."""
        params = m.row_params[contacts[c].row]
        state = constraint.impedance_row(params, T(1.0), wp.min(contacts[c].r, T(0.0)))
        return vec4(contacts[c].active * state[0], state[1], state[2], state[3])

    @wp.func
    def list_blocks(m: Model, here: Lane, links: Links, contacts: Contacts):
        """List and place the blocks that act, of equality all, of geoms those near each other; returns their end.

        The element after the last one has a D if there is no room for all.
        """
        end = here.begin
        last = here.begin + LAST
        contacts[last].D = T(0.0)
        equalities = int(EQUALITIES)  # not unrolled
        pairs = int(PAIRS)
        points = int(NPOINTS)
        for s in range(equalities):
            contacts[end].row = s
            geometry.place(m, end, links, contacts)
            end = end + 1
        if wp.static(TOUCH):
            centres = wp.zeros(shape=NPOINTS, dtype=vec3)
            for k in range(points):
                i = m.point_link[k]
                centres[k] = sp.on_link(links[i].R, links[i].x, m.point[k])
            for s in range(equalities, pairs):
                d = centres[m.row_points[2 * s + 1]] - centres[m.row_points[2 * s]]
                if block.any_of(T(m.row_shape[s][0]) - wp.dot(d, d)):  # of their bounding spheres
                    contacts[end].row = s
                    active = geometry.place_geoms(m, end, links, contacts)
                    if block.any_of(active):
                        if end < last:
                            end = end + 1
                        else:
                            contacts[last].D = contacts[last].D + T(UNSOLVED) * active
        return end

    @wp.func
    def rest_of(m: Model, c: int, links: Links, contacts: Contacts):
        """Return D of a block, and jar without velocity and acceleration."""
        s = contacts[c].row
        D = T(0.0)
        rest = vec3()
        if m.row_kind[s] == GEOMS:
            state = geoms_state(m, c, contacts)
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
        place_world(links, origin)
        motions[WORLD].accel_link = join(vec3(), -vec3(m.gravity))
        forward.clear(motions)
        end = list_blocks(m, here, links, contacts)
        for c in range(here.begin, end):
            s = contacts[c].row
            i = m.row_link[2 * s]
            j = m.row_link[2 * s + 1]
            D, rest = rest_of(m, c, links, contacts)
            velocity = geometry.rates(m, c, contacts, links[i].V, links[j].V, links[i].qd, links[j].qd)
            jar = T(m.row_params[s][1]) * velocity + rest
            jar = jar + geometry.drift(m, c, links, contacts, motions[i].accel_link, motions[j].accel_link)
            f, H = law(m, s, D, jar, T(1.0))
            contacts[c].D = D
            contacts[c].jar = jar
            contacts[c].f = f
            contacts[c].H = H
        return end

    @wp.func
    def add_forces(m: Model, here: Lane, contacts: Contacts, motions: Motions, loads: Loads):
        """Add the iterate's forces to the links' loads, and those on joints to the joints' rate."""
        if here.end > here.begin:
            forward.clear(motions)
            for c in range(here.begin, here.end):
                forward.spread(m, c, contacts, contacts[c].f, motions)
            for i in range(here.n):
                loads[i].f = loads[i].f + motions[i].twist

    @wp.func
    def correct_step(
        m: Model, here: Lane, links: Links, contacts: Contacts, motions: Motions, root: Root, status: Newton
    ):
        """Turn the tree's Newton step into that with the rows between bodies."""
        if here.end > here.begin:
            for c in range(here.begin, here.end):
                i = m.row_link[2 * contacts[c].row]
                j = m.row_link[2 * contacts[c].row + 1]
                A, B = motions[i].A, motions[j].A
                contacts[c].rate = geometry.rates(m, c, contacts, A, B, motions[i].u, motions[j].u)
            forward.solve(m, here, links, contacts, motions, root.L, status.active, T(ACCURACY))
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
        """Evaluate the rows after the trial step alpha s; returns their part of newton.evaluate_trial."""
        total = vec6()
        total[3] = contacts[here.begin + LAST].D  # no solution where a contact has no room
        for c in range(here.begin, here.end):
            s = contacts[c].row
            i = m.row_link[2 * s]
            j = m.row_link[2 * s + 1]
            step_jar = geometry.rates(m, c, contacts, motions[i].A, motions[j].A, motions[i].u, motions[j].u)
            jar = contacts[c].jar + alpha * step_jar
            f, H = law(m, s, contacts[c].D, jar, T(0.0))
            force_error = contacts[c].f - alpha * contacts[c].Hs - f
            w = T(m.row_params[s][4])
            accel_error = constraint.acceleration_for(force_error, w, H)
            total = total + vec6(
                wp.dot(step_jar, force_error),
                wp.dot(step_jar, contacts[c].Hs),
                wp.dot(step_jar, H * step_jar),
                wp.dot(accel_error, accel_error),
                w * wp.trace(H),
                T(0.0),
            )
            contacts[c].trial_jar = jar
            contacts[c].trial_force = f
            contacts[c].H = H
        return total

    @wp.func
    def accept(here: Lane, contacts: Contacts):
        """Accept the last trial step."""
        for c in range(here.begin, here.end):
            contacts[c].jar = contacts[c].trial_jar
            contacts[c].f = contacts[c].trial_force

    @wp.func
    def record(here: Lane, ck: Ck, contacts: Contacts):
        """Store jar of the blocks in the checkpoint."""
        for c in range(here.begin, here.end):
            for r in range(3):
                kin.store(ck.a, here.row, COLUMN + 3 * contacts[c].row + r, here.e, contacts[c].jar[r])

    @wp.func
    def recall(m: Model, here: Lane, links: Links, origin: vec3, ck: Ck, contacts: Contacts):
        """Place the blocks as they were in a substep, with the jar that it ended with; returns their end."""
        place_world(links, origin)
        end = list_blocks(m, here, links, contacts)
        for c in range(here.begin, end):
            s = contacts[c].row
            D, rest = rest_of(m, c, links, contacts)
            for axis in range(3):
                contacts[c].jar[axis] = kin.load(ck.a, here.row, COLUMN + 3 * s + axis, here.e)
            f, H = law(m, s, D, contacts[c].jar, T(0.0))
            contacts[c].f = f
            contacts[c].H = H
        return end

    @wp.func
    def lambda_rates(m: Model, c: int, contacts: Contacts, nodes: Nodes):
        i = m.row_link[2 * contacts[c].row]
        j = m.row_link[2 * contacts[c].row + 1]
        return geometry.rates(m, c, contacts, nodes[i].W, nodes[j].W, nodes[i].lam, nodes[j].lam)

    @wp.func
    def correct_lambda(m: Model, here: Lane, links: Links, ck: Ck, contacts: Contacts, nodes: Nodes):
        """Turn the tree's lambda, and the twists under it, into those with the rows between bodies."""
        if here.end > here.begin:
            L = backward.recall_factor(here, ck, SOLVES * here.row + SOLVES - 1, nodes)
            for c in range(here.begin, here.end):
                contacts[c].rate = lambda_rates(m, c, contacts, nodes)
            backward.solve(m, here, links, contacts, nodes, L, T(1.0), T(ENOUGH))
            for i in range(here.n):
                nodes[i].lam = nodes[i].lam + nodes[i].rate
                nodes[i].W = nodes[i].W + nodes[i].twist

    @wp.func
    def add_twist_adjoint(i: int, GA: vec6, GV: vec6, wrench: vec6, links: Links, nodes: Nodes, adj: Adjoints):
        """Add the adjoints of link i's twists, GA of A, GV of V and -wrench of W, and of turning them with the link."""
        adj[i].w = adj[i].w - wrench
        adj[i].a = adj[i].a + GA
        adj[i].v = adj[i].v + GV + wp.spatial_cross_dual(links[i].V, GA)
        turned = wp.spatial_cross_dual(nodes[i].A, GA) + wp.spatial_cross_dual(links[i].V, GV)
        adj[i].p = adj[i].p + turned - wp.spatial_cross_dual(nodes[i].W, wrench)

    @wp.func
    def add_violation_adjoint(m: Model, c: int, g: vec3, contacts: Contacts, nodes: Nodes, adj: Adjoints):
        """Add the adjoint g of an equality's violation to those of what it depends on."""
        s = contacts[c].row
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        first, second = geometry.wrenches(m, c, contacts, g)
        adj[i].p = adj[i].p - first
        adj[j].p = adj[j].p + second
        if m.row_kind[s] == JOINT:
            nodes[i].gq = nodes[i].gq - contacts[c].slope * g[0]
            nodes[j].gq = nodes[j].gq + g[0]

    @wp.func
    def turn_derivative(scale: T, w: T, v: vec3, g: vec3, rate: vec3):
        """Differentiate g . (w rate + rate x v) scale by a rotation of j relative to i, both in the frame of i."""
        a = wp.cross(g, rate)
        return T(0.5) * scale * (w * a + wp.cross(v, a) - wp.dot(g, rate) * v)

    @wp.func
    def add_point_adjoint(i: int, p: vec3, b: T, g: vec3, f: vec3, links: Links, nodes: Nodes, adj: Adjoints):
        """Add the adjoints of link i's point p: g of its acceleration plus b times its velocity, -f of that of W."""
        V = links[i].V
        spin = wp.spatial_top(V)
        across = wp.cross(g, spin)
        GV = force_at(p, b * g + across) + join(wp.cross(sp.point_velocity(V, p), g), vec3())
        add_twist_adjoint(i, force_at(p, g), GV, force_at(p, f), links, nodes, adj)
        g_p = wp.cross(g, wp.spatial_top(nodes[i].A)) + wp.cross(b * g + across, spin)
        adj[i].p = adj[i].p + force_at(p, g_p - wp.cross(f, wp.spatial_top(nodes[i].W)))

    @wp.func
    def add_turn_adjoint(m: Model, s: int, b: T, g: vec3, f: vec3, links: Links, nodes: Nodes, adj: Adjoints):
        """Add the adjoints of both links in a TURN: g of jar, -f of the rows' rate under lambda.

        In the frame R of i, jar is h(accel) - |rate|^2 v scale / 2 + b h(rate), h(x) = scale (w x + x x v).
        """
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        w, v, R = geometry.turn_of(m, s, links)
        scale = T(0.5) * T(m.row_shape[s][0])
        rate, accel = geometry.turn_motion(R, links[i].V, links[j].V, nodes[i].A, nodes[j].A)
        rate_W = wp.transpose(R) * wp.spatial_top(nodes[j].W - nodes[i].W)
        own = wp.transpose(R) * wp.spatial_top(links[i].V)
        half_sq = T(0.5) * wp.dot(rate, rate)
        g_accel = scale * (w * g + wp.cross(v, g))
        g_rate = b * g_accel - (scale * wp.dot(g, v)) * rate - wp.cross(g_accel, own)
        g_own = -wp.cross(rate, g_accel)
        g_rate_W = -scale * (w * f + wp.cross(v, f))
        # A rotation of j relative to i turns the quaternion, and one of i all vectors in its frame.
        torque = turn_derivative(scale, w, v, g, accel + b * rate) - turn_derivative(scale, w, v, f, rate_W)
        torque = torque - (T(0.5) * half_sq) * g_accel
        turned = wp.cross(accel + wp.cross(own, rate), g_accel) + wp.cross(rate, g_rate) + wp.cross(own, g_own)
        turned = turned + wp.cross(rate_W, g_rate_W)
        adj[j].p = adj[j].p + join(R * torque, vec3())
        adj[i].p = adj[i].p - join(R * (torque + turned), vec3())
        GA = join(R * g_accel, vec3())
        wrench = join(-(R * g_rate_W), vec3())
        add_twist_adjoint(j, GA, join(R * g_rate, vec3()), wrench, links, nodes, adj)
        add_twist_adjoint(i, -GA, join(R * (g_own - g_rate), vec3()), -wrench, links, nodes, adj)

    @wp.func
    def equality_adjoint(
        m: Model, here: Lane, c: int, rate: vec3, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints
    ):
        """Add the part of an equality's block, with that rate under lambda."""
        s = contacts[c].row
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        kind = m.row_kind[s]
        b = T(m.row_params[s][1])
        f = contacts[c].f
        g = contacts[c].H * rate
        r, norm = norm_of(m, s, links)
        size = wp.length(norm)
        state = equality_state(m, s, norm)
        g_norm = state[1] * wp.dot(contacts[c].jar, rate) + state[3] * wp.dot(g, r)
        g_norm = pick(T(SMALLEST), size, g_norm / size, T(0.0))
        add_violation_adjoint(m, c, state[2] * g + g_norm * r, contacts, nodes, adj)
        partner = m.row_partner[s]
        if partner != s:
            other = g_norm * geometry.violation(m, partner, links)
            add_violation_adjoint(m, here.begin + partner, other, contacts, nodes, adj)
        if wp.static(JOINTS):
            if kind == JOINT:
                curvature = geometry.polynomial(m, s, links[i].q - T(m.row_shape[s][1]))[2]
                change = f[0] * nodes[i].lam - g[0] * (nodes[i].qacc + b * links[i].qd)
                nodes[i].gq = nodes[i].gq + curvature * change
                nodes[i].gqd = nodes[i].gqd - contacts[c].slope * b * g[0]
                nodes[j].gqd = nodes[j].gqd + b * g[0]
        if wp.static(POINTS):
            if kind == POINT:
                add_point_adjoint(i, contacts[c].q, b, -g, -f, links, nodes, adj)
                add_point_adjoint(j, contacts[c].p, b, g, f, links, nodes, adj)
        if wp.static(TURNS):
            if kind == TURN:
                add_turn_adjoint(m, s, b, g, f, links, nodes, adj)

    @wp.func
    def add_end_adjoint(i: int, p: vec3, b: T, g: vec3, f: vec3, links: Links, nodes: Nodes, adj: Adjoints):
        """Add the adjoints of link i's twists at its end of a contact, as add_point_adjoint; returns that of p."""
        G = force_at(p, g)
        wrench = force_at(p, f)
        motion = b * links[i].V + nodes[i].B
        adj[i].w = adj[i].w - wrench
        adj[i].v = adj[i].v + b * G
        adj[i].b = adj[i].b + G
        adj[i].p = adj[i].p + wp.spatial_cross_dual(motion, G) - wp.spatial_cross_dual(nodes[i].W, wrench)
        return wp.cross(g, wp.spatial_top(motion)) - wp.cross(f, wp.spatial_top(nodes[i].W))

    @wp.func
    def geoms_adjoint(m: Model, c: int, rate: vec3, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints):
        """Add the part of two geoms' block, with that rate under lambda, as constraint.add_contacts_adjoint."""
        s = contacts[c].row
        i = m.row_link[2 * s]
        j = m.row_link[2 * s + 1]
        b = T(m.row_params[s][1])
        E = contacts[c].E
        f = contacts[c].f
        g = contacts[c].H * rate
        state = geoms_state(m, c, contacts)
        g_r = g[2] * state[3] - wp.dot(f, rate) * state[1]
        g_turn = wp.cross(g, contacts[c].jar - vec3(T(0.0), T(0.0), state[2])) - wp.cross(f, rate)
        g_p = add_end_adjoint(i, contacts[c].p, b, -(E * g), -(E * f), links, nodes, adj)
        g_p = g_p + add_end_adjoint(j, contacts[c].p, b, E * g, E * f, links, nodes, adj)
        first, second = geometry.geoms_adjoint(m, s, links, g_p, g_r, g_turn)
        adj[i].p = adj[i].p + first
        adj[j].p = adj[j].p + second

    @wp.func
    def add_adjoint(m: Model, here: Lane, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints):
        """Add the rows' part of phi, -f . rate under lambda, to the adjoints of links and joints."""
        for c in range(here.begin, here.end):
            rate = lambda_rates(m, c, contacts, nodes)
            if m.row_kind[contacts[c].row] == GEOMS:
                if wp.static(TOUCH):
                    geoms_adjoint(m, c, rate, links, contacts, nodes, adj)
            else:
                equality_adjoint(m, here, c, rate, links, contacts, nodes, adj)

    return functions(locals())

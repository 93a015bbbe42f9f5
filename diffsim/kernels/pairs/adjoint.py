"""The adjoint of rows between two bodies (pairs.py).

It begins at phi = -f . rate with rate the rows' velocity under lambda, as for contacts (constraint.py). Newton's matrix
is symmetric, so lambda takes the same conjugate gradients as a step of Newton's method (pair_solver.py).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.cone import elliptic_cone, pyramidal_cone
from diffsim.kernels.mujoco.ground import pair_column
from diffsim.kernels.pairs.geometry import pair_geometry
from diffsim.kernels.pairs.listing import pair_list
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.pairs.solver import row_solver
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.branches import branch_solver
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.robot.pairs import GEOMS, JOINT, POINT, TURN

ACCURACY_ADJOINT = 1e-12, 1e-6  # as ACCURACY of pairs.py, in float64 and in float32
SMALLEST = 1e-12  # of a violation whose direction is defined


@cache
def pair_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the rows' part of the adjoint."""
    t, block, kin, geometry = types(spec), blocks(spec), kinematics(spec), pair_geometry(spec)
    rows, listed, solver, sp = pair_rows(spec), pair_list(spec), row_solver(spec, "Nodes"), spatial(spec)
    recall_factor = branch_solver(spec, "Nodes").recall_factor
    T, vec3, vec6, pick, join, force_at = t.T, t.vec3, t.vec6, block.pick, sp.join, sp.force_at
    Model, Lane, Ck, Links, Contacts, Nodes, Adjoints, Array = (
        getattr(t, name) for name in "Model Lane Checkpoint Links Contacts Nodes Adjoints Ts".split()
    )
    cone = pyramidal_cone(spec) if "pyramid" in spec.features else elliptic_cone(spec)
    SOLVES, LEARNED = spec.solves, spec.parameters > 0
    COLUMN = pair_column(spec)  # of jar in the checkpoint
    COLUMNS = spec.columns.pairs
    JOINTS, POINTS, TURNS, TOUCH = spec.has("joint_rows point_rows turn_rows geoms_rows")
    ENOUGH = ACCURACY_ADJOINT[int(t.U == wp.float32)]

    @wp.func
    def recall(m: Model, here: Lane, links: Links, origin: vec3, ck: Ck, contacts: Contacts):
        """Place the blocks as they were in a substep, with the jar that it ended with; returns their end."""
        listed.place_world(links, origin)
        end = listed.list_blocks(m, here, links, contacts)
        for c in range(here.begin, end):
            s = contacts[c].row
            D, rest = rows.rest_of(m, here, c, links, contacts)
            for axis in range(3):
                contacts[c].jar[axis] = kin.load(ck.a, here.row, COLUMN + 3 * s + axis, here.e)
            f, H = rows.law(m, here, s, D, contacts[c].jar, T(0.0))
            contacts[c].f = f
            contacts[c].H = H
        return end

    @wp.func
    def lambda_rates(m: Model, c: int, contacts: Contacts, nodes: Nodes):
        i, j = geometry.ends(m, contacts[c].row)
        return geometry.rates(m, c, contacts, nodes[i].W, nodes[j].W, nodes[i].lam, nodes[j].lam)

    @wp.func
    def correct_lambda(m: Model, here: Lane, links: Links, ck: Ck, contacts: Contacts, nodes: Nodes):
        """Turn the tree's lambda, and the twists under it, into those with the rows between bodies."""
        if here.end > here.begin:
            L = recall_factor(here, ck, SOLVES * here.row + SOLVES - 1, nodes)
            for c in range(here.begin, here.end):
                contacts[c].rate = lambda_rates(m, c, contacts, nodes)
            solver.solve(m, here, links, contacts, nodes, L, T(1.0), T(ENOUGH))
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
        i, j = geometry.ends(m, s)
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
        i, j = geometry.ends(m, s)
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
        i, j = geometry.ends(m, s)
        kind = m.row_kind[s]
        b = T(m.row_params[s][1])
        f = contacts[c].f
        g = contacts[c].H * rate
        r, norm = rows.norm_of(m, s, links)
        size = wp.length(norm)
        state = rows.equality_state(m, s, norm)
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
    def add_constants_adjoint(m: Model, here: Lane, c: int, rate: vec3, contacts: Contacts, adj_parameters: Array):
        """Add the derivatives by parameters of a block's part, -f . rate."""
        s = contacts[c].row
        f_rate = wp.dot(contacts[c].f, rate)
        adj_parameters[COLUMNS + 2 * s + 1] = adj_parameters[COLUMNS + 2 * s + 1] + f_rate
        if wp.static(TOUCH):
            if m.row_kind[s] == GEOMS:
                coef = rows.constants(m, here, s)
                jar = contacts[c].jar
                state = rows.geoms_state(m, here, c, contacts)
                by_mu = cone.friction_derivative(state[0], coef[2], T(m.row_params[s][3]), jar, rate)
                adj_parameters[COLUMNS + 2 * s] = adj_parameters[COLUMNS + 2 * s] - by_mu

    @wp.func
    def geoms_adjoint(
        m: Model, here: Lane, c: int, rate: vec3, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints
    ):
        """Add the part of two geoms' block, with that rate under lambda, as constraint.add_contacts_adjoint."""
        s = contacts[c].row
        i, j = geometry.ends(m, s)
        b = rows.constants(m, here, s)[1]
        E = contacts[c].E
        f = contacts[c].f
        g = contacts[c].H * rate
        state = rows.geoms_state(m, here, c, contacts)
        g_r = g[2] * state[3] - wp.dot(f, rate) * state[1]
        g_turn = wp.cross(g, contacts[c].jar - vec3(T(0.0), T(0.0), state[2])) - wp.cross(f, rate)
        g_p = add_end_adjoint(i, contacts[c].p, b, -(E * g), -(E * f), links, nodes, adj)
        g_p = g_p + add_end_adjoint(j, contacts[c].p, b, E * g, E * f, links, nodes, adj)
        n, g_n = geometry.normal_of(c, contacts, g_turn)
        second = listed.contact_adjoint(m, c, links, contacts, n, g_p, g_r, g_n)
        adj[i].p = adj[i].p + force_at(contacts[c].p, g_p) + join(wp.cross(n, g_n), vec3()) - second
        adj[j].p = adj[j].p + second

    @wp.func
    def add_adjoint(
        m: Model, here: Lane, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints, adj_parameters: Array
    ):
        """Add the rows' part of phi, -f . rate under lambda, to the adjoints of links, joints and constants."""
        for c in range(here.begin, here.end):
            rate = lambda_rates(m, c, contacts, nodes)
            if wp.static(LEARNED):
                add_constants_adjoint(m, here, c, rate, contacts, adj_parameters)
            if m.row_kind[contacts[c].row] == GEOMS:
                if wp.static(TOUCH):
                    geoms_adjoint(m, here, c, rate, links, contacts, nodes, adj)
            else:
                equality_adjoint(m, here, c, rate, links, contacts, nodes, adj)

    return functions(locals())

"""The adjoint of rows between two bodies (rows.py).

It begins at phi = -f . rate with rate the rows' velocity under lambda, as for contacts (ground.py). Newton's matrix
is symmetric, so lambda takes the same conjugate gradients as a step of Newton's method (solver.py).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.cone import elliptic_cone, pyramidal_cone
from diffsim.kernels.mujoco.ground import pair_column
from diffsim.kernels.pairs.equality_adjoint import equality_adjoint
from diffsim.kernels.pairs.geoms import pair_geoms
from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.pairs.listing import pair_list
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.pairs.solver import row_solver
from diffsim.kernels.pairs.touch_adjoint import touch_adjoint
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.tree.branches import branch_solver
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.robot.types import GEOMS

ACCURACY_ADJOINT = 1e-12, 1e-6  # as ACCURACY of rows.py, in float64 and in float32


@cache
def pair_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the rows' part of the adjoint."""
    t, kin, J, equality = types(spec), kinematics(spec), pair_jacobian(spec), equality_adjoint(spec)
    rows, listed, solver, sp = pair_rows(spec), pair_list(spec, True), row_solver(spec, "Nodes"), spatial(spec)
    recall_factor = branch_solver(spec, "Nodes").recall_factor
    T, vec3, vec6, join, force_at = t.T, t.vec3, t.vec6, sp.join, sp.force_at
    Model, Lane, Ck, Links, Contacts, Nodes, Adjoints, Array = (
        getattr(t, name) for name in "Model Lane Checkpoint Links Contacts Nodes Adjoints Ts".split()
    )
    cone = pyramidal_cone(spec) if "pyramid" in spec.features else elliptic_cone(spec)
    SOLVES, LEARNED = spec.solves, spec.parameters > 0
    COLUMN = pair_column(spec)  # of jar in the checkpoint
    COLUMNS = spec.columns.pairs
    TOUCH, TREES = spec.has("geoms_rows trees")
    geoms, touch = (pair_geoms(spec, True), touch_adjoint(spec)) if TOUCH else (None, None)
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
        i, j = J.ends(m, contacts[c].row)
        return J.rates(m, c, contacts, nodes[i].W, nodes[j].W, nodes[i].lam, nodes[j].lam)

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
    def add_end_adjoint(i: int, p: vec3, b: T, g: vec3, f: vec3, links: Links, nodes: Nodes, adj: Adjoints):
        """Add the adjoints of link i's twists at its end of a contact, see equality_adjoint.py; returns that of p."""
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
        """Add the part of two geoms' block, with that rate under lambda, as ground.add_contacts_adjoint."""
        s = contacts[c].row
        i, j = J.ends(m, s)
        b = rows.constants(m, here, s)[1]
        E = contacts[c].E
        f = contacts[c].f
        g = contacts[c].H * rate
        state = rows.geoms_state(m, here, c, contacts)
        g_r = g[2] * state[3] - wp.dot(f, rate) * state[1]
        g_turn = wp.cross(g, contacts[c].jar - vec3(T(0.0), T(0.0), state[2])) - wp.cross(f, rate)
        g_p = add_end_adjoint(i, contacts[c].q, b, -(E * g), -(E * f), links, nodes, adj)
        g_p = g_p + add_end_adjoint(j, contacts[c].p, b, E * g, E * f, links, nodes, adj)
        n = geoms.normal_of(c, contacts)
        g_n = touch.normal_adjoint(n, E, g_turn)
        second = touch.contact_adjoint(m, c, links, contacts, n, g_p, g_r, g_n)
        first = force_at(contacts[c].p, g_p) + join(wp.cross(n, g_n), vec3()) - second
        if wp.static(TREES):
            apart = J.offset(J.reference(m, s), i, links)
            first = first + join(wp.cross(apart, wp.spatial_bottom(first)), vec3())
        adj[i].p = adj[i].p + first
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
                equality.add_adjoint(m, here, c, rate, links, contacts, nodes, adj)

    return functions(locals())

"""The adjoint of equality between two bodies (equality.py), for adjoint.py."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.equality import equality_rows
from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.types import JOINT, POINT, TURN

SMALLEST = 1e-12  # of a violation whose direction is defined


@cache
def equality_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of equality's part."""
    t, sp, J, rows, equality = types(spec), spatial(spec), pair_jacobian(spec), pair_rows(spec), equality_rows(spec)
    T, vec3, vec6, pick, join, force_at = t.T, t.vec3, t.vec6, blocks(spec).pick, sp.join, sp.force_at
    Model, Lane, Links, Contacts, Nodes, Adjoints = t.Model, t.Lane, t.Links, t.Contacts, t.Nodes, t.Adjoints
    JOINTS, POINTS, TURNS = spec.has("joint_rows point_rows turn_rows")

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
        """Add the adjoint g of a block's violation to those of what it depends on."""
        s = contacts[c].row
        i, j = J.ends(m, s)
        first, second = J.wrenches(m, c, contacts, g)
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
        i, j = J.ends(m, s)
        w, v, R = equality.turn_of(m, s, links)
        scale = T(0.5) * T(m.row_torquescale[s])
        rate, accel = equality.turn_motion(R, links[i].V, links[j].V, nodes[i].A, nodes[j].A)
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
    def add_adjoint(
        m: Model, here: Lane, c: int, rate: vec3, links: Links, contacts: Contacts, nodes: Nodes, adj: Adjoints
    ):
        """Add the part of a block, with that rate under lambda."""
        s = contacts[c].row
        i, j = J.ends(m, s)
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
            other = g_norm * equality.violation(m, partner, links)
            add_violation_adjoint(m, here.begin + partner, other, contacts, nodes, adj)
        if wp.static(JOINTS):
            if kind == JOINT:
                curvature = equality.polynomial(m, s, links)[2]
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

    return functions(locals())

"""Partial derivatives of phi (backward.py): of each link, then summed over subtrees and projected on the joints."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.mujoco.ground import ground_adjoint
from diffsim.kernels.mujoco.limits import joint_limits
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.link import link_law


@cache
def partial_derivatives(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of the stages `differentiate` and `project`."""
    t, sp, kin, sums = types(spec), spatial(spec), kinematics(spec), lane_sums(spec)
    T, vec3, Model, Lane, Ck = t.T, t.vec3, t.Model, t.Lane, t.Checkpoint
    Link, Node, Adjoint, Base, Links, Nodes = t.Link, t.Node, t.Adjoint, t.Base, t.Links, t.Nodes
    Adjoints, Array, join, load, link_of = t.Adjoints, t.Ts, sp.join, kin.load, kin.link_of
    link, joint, ground, limits = link_law(spec), joint_law(spec), ground_adjoint(spec), joint_limits(spec)
    CONTACT, CLAMP, LIMIT, BASE_DAMPED = spec.has("contact clamp limit base_damping")
    CONSTRAINED, DAMPED, IMPLICIT = spec.constrained, spec.damped, spec.implicit
    LIMIT = LIMIT and not CONSTRAINED  # the penalty law
    FLOATING, VADR, NV, NBALL = spec.floating, spec.dof0 - 1, spec.nv, spec.nball
    INERT, FIRST = spec.inert, 0 if FLOATING else 1 + spec.inert  # the first link with inertia
    THREADS_PER_ENV, SHARERS, TRUNK, SLOTS = spec.threads_per_env, spec.sharers, spec.trunk, spec.room

    @wp.func
    def differentiate(
        # model
        m: Model,
        here: Lane,
        # state in
        links: Links,
        nodes: Nodes,
        carrier: t.CarrierPos,
        ck: Ck,
        # out
        adj: Adjoints,
        adj_parameters: Array,
    ):
        """Compute the partial derivatives of phi of each link into adj."""
        for i in range(1, INERT + 1):
            adj[i] = Adjoint()
        s = int(0)  # the contact in the checkpoint
        for i in range(FIRST, here.n):
            k = here.at + i
            own = link.link_adjoint(m, here, k, links[i], nodes[i], carrier)
            if wp.static(CONSTRAINED and CONTACT):
                own, s = ground.add_contacts_adjoint(
                    m, here, k, s, links[i], nodes[i], carrier, ck, own, adj_parameters
                )
            if wp.static(DAMPED):
                own = link.add_damping_adjoint(m, here, k, links[i], nodes[i], own)
            adj[i] = own

    @wp.func
    def joint_derivatives(m: Model, here: Lane, i: int, ck: Ck, link: Link, own: Node):
        """Differentiate the joint's force with respect to q and qd, and to that of its motors."""
        k = here.at + i
        end_qd = link.qd
        if wp.static(IMPLICIT and LIMIT):
            end_qd = end_qd + here.h * load(ck.a, here.row, VADR + link_of(m, k), here.e)
        unclamped = T(1.0)
        if wp.static(CLAMP):
            unclamped = own.unclamped
        derivatives = joint.derivatives(m, here, k, link.q, link.qd, end_qd, unclamped)
        if wp.static(CONSTRAINED):
            derivatives = derivatives + limits.joint_derivatives(m, here, k, link.q, link.qd, own.qacc)
        return derivatives, unclamped

    @wp.func
    def project(m: Model, here: Lane, ck: Ck, links: Links, nodes: Nodes, adj: Adjoints):
        """Sum adj over subtrees, and project it on the joints into nodes' gq, gqd and gtau."""
        slots = int(SLOTS)
        if wp.static(SHARERS > 1):
            sums.sharers.add_adjoints(adj)
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_adjoints(adj)
            if i > 0 and i < here.n:
                k = here.at + i
                p = m.parent[k]
                turned = i
                if wp.static(NBALL > 0):
                    p = m.inboard[k]
                    turned = m.outboard[k]
                own = nodes[i]
                derivatives, unclamped = joint_derivatives(m, here, i, ck, links[i], own)
                S = links[i].S
                total = adj[i]
                xv = total.v - wp.spatial_cross_dual(links[p].V, total.a)
                gq = (
                    own.gq
                    + wp.dot(total.p, S)
                    - wp.dot(xv, wp.spatial_cross(S, links[p].V))
                    - wp.dot(total.w, wp.spatial_cross(S, nodes[p].W))
                    - wp.dot(total.a, wp.spatial_cross(S, nodes[p].A))
                    - own.lam * derivatives[0]
                )
                if wp.static(CONSTRAINED):
                    gq = gq - wp.dot(total.b, wp.spatial_cross(S, nodes[p].B))
                if wp.static(DAMPED):
                    gq = gq - wp.dot(total.d, wp.spatial_cross(S, nodes[p].D))
                    gq = gq - wp.dot(total.w1, wp.spatial_cross(S, nodes[p].W1))
                nodes[i].gq = gq
                xa = xv - wp.spatial_cross_dual(links[turned].V, total.a)
                nodes[i].gqd = own.gqd + wp.dot(xa, S) - own.lam * derivatives[1]
                nodes[i].gtau = own.gtau - unclamped * own.lam
                if wp.static(NBALL > 0):
                    p = m.parent[k]
                if wp.static(FLOATING) or p > 0:
                    adj[p] = link.add_adjoints(adj[p], total)

    @wp.func
    def correct_ball_springs(m: Model, here: Lane, links: Links, nodes: Nodes):
        """Correct the springs' gradient: a rotation vector's derivative in the tangent space is not the identity."""
        for b in range(m.ball_count[here.lane]):
            i = m.ball_slot[here.lane * NBALL + b]
            lb = vec3(nodes[i].lam, nodes[i + 1].lam, nodes[i + 2].lam)
            rotation = vec3(links[i].q, links[i + 1].q, links[i + 2].q)
            lb = T(m.stiffness[here.at + i]) * (sp.log_adjoint(rotation, lb) - lb)
            for k in range(3):
                nodes[i + k].gq = nodes[i + k].gq + lb[k]

    @wp.func
    def project_base(m: Model, link: Link, own: Node, adj: Adjoint, base: Base):
        """Project adj on the base: a translation, whose "parent" twists are purely linear, then a ball joint."""
        vp = join(vec3(), base.v)
        wl = join(vec3(), wp.spatial_bottom(own.W))
        ap = join(vec3(), base.vdot)
        xv = adj.v - wp.spatial_cross_dual(vp, adj.a)
        tq = adj.p - wp.spatial_cross_dual(vp, xv)
        tq = tq - wp.spatial_cross_dual(wl, adj.w) - wp.spatial_cross_dual(ap, adj.a)
        if wp.static(CONSTRAINED):
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.B)), adj.b)
        if wp.static(DAMPED):
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.D)), adj.d)
            tq = tq - wp.spatial_cross_dual(join(vec3(), wp.spatial_bottom(own.W1)), adj.w1)
        tw = xv - wp.spatial_cross_dual(link.V, adj.a)
        base.gp = base.gp + wp.spatial_bottom(adj.p)
        base.gr = base.gr + wp.transpose(link.R) * wp.spatial_top(tq)
        base.gv = base.gv + wp.spatial_bottom(xv)
        base.gw = base.gw + wp.transpose(link.R) * wp.spatial_top(tw)
        if wp.static(BASE_DAMPED):  # its force is one on v and w, wherever the base is
            base.gv = base.gv + T(m.base_damping) * wp.spatial_bottom(own.W)
            base.gw = base.gw + T(m.base_damping) * (wp.transpose(link.R) * wp.spatial_top(own.W))
        return base

    return functions(locals())

"""One link's part of the equations of motion: its inertia and bias force, and their adjoints."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.drag import drag_law
from diffsim.kernels.laws.soft_contact import contact_law
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec


@cache
def link_law(spec: KernelSpec) -> SimpleNamespace:
    """Make a link's part of the equations of motion, and its adjoint."""
    t, sp, contact, drag = types(spec), spatial(spec), contact_law(spec), drag_law(spec)
    T, vec3, mat3, Model, Lane, Link = t.T, t.vec3, t.mat3, t.Model, t.Lane, t.Link
    Node, Adjoint = t.Node, t.Adjoint
    momentum, CarrierPos, Load, VARIED = sp.momentum, t.CarrierPos, t.Load, spec.varied
    # With MuJoCo's constraints contacts are added in each pass of the solve: mujoco/ground.py.
    GRAVCOMP, DRAG, CONTACT = spec.has("gravcomp drag contact")
    CONTACT = CONTACT and not spec.constrained
    NBALL, INERT = spec.nball, spec.inert
    FIRST = 0 if spec.floating else 1 + INERT  # the first link with inertia

    @wp.func
    def world_inertia(m: Model, k: int, link: Link):
        """Return link k's centre of mass and its inertia about that, in world axes."""
        return sp.on_link(link.R, link.x, m.com[k]), link.R * mat3(m.inertia[k]) * wp.transpose(link.R)

    @wp.func
    def gravcomp_wrench(m: Model, k: int, link: Link):
        """Return the point where gravity compensation acts on link k, its force and its wrench."""
        p = sp.on_link(link.R, link.x, m.lift_position[k])
        f = -T(m.lift[k]) * vec3(m.gravity)
        return p, f, sp.force_at(p, f)

    @wp.func
    def link_inertia(m: Model, here: Lane, k: int, link: Link, carrier: CarrierPos):
        """Compute the inertia and bias force of link k alone, soft contacts included."""
        com, inertia = world_inertia(m, k, link)
        V = link.V
        mass = T(m.mass[k])
        if wp.static(VARIED):
            inertia = here.mass * inertia
            mass = here.mass * mass
        load = Load()
        load.b = mass * wp.skew(com)
        load.a = inertia - load.b * wp.skew(com)
        load.d = wp.diag(vec3(mass, mass, mass))
        load.f = wp.spatial_cross_dual(V, momentum(mass, com, inertia, V))
        if wp.static(GRAVCOMP):
            _p, _f, up = gravcomp_wrench(m, k, link)
            if wp.static(VARIED):
                up = here.mass * up
            load.f = load.f - up
        if wp.static(DRAG):
            load.f = load.f - drag.drag_wrench(m, k, link.R, com, V)
        if wp.static(CONTACT):
            load = contact.add_contacts(m, here, k, link, carrier, load)
        return load

    @wp.func
    def outward(m: Model, here: Lane, carrier: t.CarrierPos, links: t.Links, motions: t.Motions, loads: t.Loads):
        """Compute the links' velocity products, inertias and bias forces from their kinematics."""
        for i in range(1, here.n):
            turning = i
            if wp.static(NBALL > 0):
                turning = m.inboard[here.at + i]
            motions[i].C = wp.spatial_cross(links[turning].V, links[i].S * links[i].qd)
        for i in range(1, INERT + 1):
            loads[i] = Load()
        for i in range(FIRST, here.n):
            loads[i] = link_inertia(m, here, here.at + i, links[i], carrier)

    @wp.func
    def link_adjoint(m: Model, here: Lane, k: int, link: Link, node: Node, carrier: CarrierPos):
        """Compute the adjoints of link k's part of phi, about the carrier's position."""
        com, inertia = world_inertia(m, k, link)
        V = link.V
        W = node.W
        Iv = momentum(T(m.mass[k]), com, inertia, V)
        adj = Adjoint()
        adj.a = momentum(T(m.mass[k]), com, inertia, W)
        adj.w = momentum(T(m.mass[k]), com, inertia, node.A) + wp.spatial_cross_dual(V, Iv)
        adj.v = momentum(T(m.mass[k]), com, inertia, wp.spatial_cross(W, V))
        adj.v = adj.v - wp.spatial_cross_dual(W, Iv) + wp.spatial_cross_dual(V, adj.a)
        if wp.static(GRAVCOMP):  # as an external force, see force.py
            p, f, up = gravcomp_wrench(m, k, link)
            adj.w = adj.w - up
            adj.p = -sp.force_at(p, wp.cross(f, wp.spatial_top(W))) - wp.spatial_cross_dual(W, up)
        if wp.static(VARIED):
            adj.a = here.mass * adj.a
            adj.w = here.mass * adj.w
            adj.v = here.mass * adj.v
            if wp.static(GRAVCOMP):
                adj.p = here.mass * adj.p
        if wp.static(DRAG):
            adj.w = adj.w - drag.drag_wrench(m, k, link.R, com, V)
            adj.v = adj.v + drag.drag_adjoint(m, k, link.R, com, V, W)
        if wp.static(CONTACT):
            adj = contact.add_contacts_adjoint(m, here, k, link, node, carrier, adj)
        return adj

    @wp.func
    def add_damping_adjoint(m: Model, here: Lane, k: int, link: Link, node: t.Node, adj: Adjoint):
        """Add the adjoints of D and W1 in phi's part W1 . I D, where damping follows the constraints."""
        com, inertia = world_inertia(m, k, link)
        adj.d = momentum(T(m.mass[k]), com, inertia, node.W1)
        adj.w1 = momentum(T(m.mass[k]), com, inertia, node.D)
        if wp.static(VARIED):
            adj.d = here.mass * adj.d
            adj.w1 = here.mass * adj.w1
        return adj

    @wp.func
    def add_adjoints(x: Adjoint, y: Adjoint):
        """Return the sum of two adjoints."""
        x.a = x.a + y.a
        x.v = x.v + y.v
        x.w = x.w + y.w
        x.p = x.p + y.p
        if wp.static(spec.constrained):
            x.b = x.b + y.b
        if wp.static(spec.damped):
            x.d = x.d + y.d
            x.w1 = x.w1 + y.w1
        return x

    return functions(locals())

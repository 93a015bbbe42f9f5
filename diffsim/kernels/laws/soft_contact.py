"""The contact of spheres with the ground, Eq. 3, and its adjoint.

With depth d < 0, point velocity v and its normal component v_z (the rate of d),

    f_n = (k_d v_z - k_n) d,   f_t = -c v_t,   c = min(k_t, mu f_n / |v_t|),

active where f_n > 0, so the ground never pulls: for k_d v_z >= k_n the sphere leaves faster than the ground can push.
At zero slip c = k_t without a division.

Implicit step: the law is linear in the acceleration a of the point, f = f(d, v) - B a, with
B = h diag(c, c, -k_d d) and c lagged; the explicit law is B = 0.

On a terrain (terrain.py) the law and its adjoint act in the frame E of the feature that the sphere touches.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.terrain import terrain_contact
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def contact_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the law of soft contact, and its adjoint."""
    t, sp, block = types(spec), spatial(spec), blocks(spec)
    T, vec3, vec4, Model, Lane, Link = t.T, t.vec3, t.vec4, t.Model, t.Lane, t.Link
    Node, Adjoint = t.Node, t.Adjoint
    CarrierPos, force_at, point_velocity, pick = t.CarrierPos, sp.force_at, sp.point_velocity, block.pick
    ground, TERRAIN = terrain_contact(spec), "terrain" in spec.features
    IMPLICIT, in_frame, in_world = spec.implicit, ground.in_frame, ground.in_world

    @wp.func
    def sphere_state(m: Model, here: Lane, c: int, link: Link, carrier: CarrierPos):
        """Compute the contact point of sphere c.

        Returns:
            its point p nearest to the ground, the velocity of p in the frame E, the depth, E, and the ground's
            curvature in it.
        """
        centre = sp.on_link(link.R, link.x, m.contact_position[c])
        r = T(m.contact_radius[c])
        depth, E, curvature = ground.distance(m, here, c, ground.about_carrier(link, centre), carrier, r)
        p = centre - in_world(E, vec3(T(0.0), T(0.0), r))
        v = in_frame(E, point_velocity(link.V, p))
        return p, v, depth, E, curvature

    @wp.func
    def is_active(here: Lane, d: T, v: vec3):
        """Return 1 where the normal force is positive, else 0."""
        return pick(d, T(0.0), pick(here.k_d * v[2], here.k_n, T(1.0), T(0.0)), T(0.0))

    @wp.func
    def friction_viscosity(here: Lane, f_n: T, v: vec3):
        """Return the viscosity c of friction, and 1 where the sphere slides, else 0."""
        speed = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        friction_limit = here.mu * f_n
        viscous = here.k_t * speed
        sliding = pick(friction_limit, viscous, T(1.0), T(0.0))
        return pick(friction_limit, viscous, friction_limit / speed, here.k_t), sliding

    @wp.func
    def contact_force(here: Lane, d: T, v: vec3):
        """Return the force on the sphere and the effective viscosity c of friction, as (f, c)."""
        f_n = (here.k_d * v[2] - here.k_n) * d
        c, sliding = friction_viscosity(here, f_n, v)
        return vec4(-c * v[0], -c * v[1], f_n, c)

    @wp.func
    def contact_resistance(here: Lane, d: T, c: T):
        """Return the diagonal of B."""
        return vec3(here.h * c, here.h * c, -here.h * here.k_d * d)

    @wp.func
    def contact_adjoint(here: Lane, d: T, v: vec3, a: vec3, g: vec3, h: T):
        """Return the adjoints of v and of d in g . f(d, v, a); h = 0 if explicit."""
        s = here.k_d * v[2] - here.k_n
        f_n = s * d
        c, sliding = friction_viscosity(here, f_n, v)
        g_n = g[2]
        gx = -c * g[0]
        gy = -c * g[1]
        # Where the sphere slides, f_t - h c a_t = -c (v_t + h a_t) with c = mu f_n / |v_t|.
        speed2 = pick(T(0.0), sliding, v[0] * v[0] + v[1] * v[1], T(1.0))
        g_c = -sliding * (g[0] * (v[0] + h * a[0]) + g[1] * (v[1] + h * a[1]))
        g_n = g_n + g_c * here.mu / wp.sqrt(speed2)
        gx = gx - g_c * c * v[0] / speed2
        gy = gy - g_c * c * v[1] / speed2
        g_d = g_n * s + g[2] * h * here.k_d * a[2]
        return vec4(gx, gy, g_n * here.k_d * d, g_d)

    @wp.func
    def add_contacts(m: Model, here: Lane, k: int, link: Link, carrier: CarrierPos, load: t.Load):
        """Add link k's contacts to its load."""
        for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
            p, v, depth, E, _ = sphere_state(m, here, c, link, carrier)
            active = is_active(here, depth, v)
            if block.any_of(active):
                depth = active * depth  # 0 on inactive spheres, and so is their force
                fc = contact_force(here, depth, v)
                f = in_world(E, vec3(fc[0], fc[1], fc[2]))
                if wp.static(IMPLICIT):
                    B = active * contact_resistance(here, depth, fc[3])
                    if wp.static(TERRAIN):
                        D = E * wp.diag(B) * wp.transpose(E)
                        f = f - D * vec3(m.gravity)
                    else:
                        f = f - wp.cw_mul(B, vec3(m.gravity))
                        D = wp.diag(B)
                    PB = wp.skew(p) * D
                    load.a = load.a - PB * wp.skew(p)
                    load.b = load.b + PB
                    load.d = load.d + D
                load.f = load.f - force_at(p, f)
        return load

    @wp.func
    def add_contacts_adjoint(
        # model
        m: Model,
        here: Lane,
        k: int,
        # state in
        link: Link,
        node: Node,
        carrier: CarrierPos,
        # adjoint in and out
        adj: Adjoint,
    ):
        """Add the contacts' part of phi to link k's adjoints."""
        for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
            p, v, depth, E, curvature = sphere_state(m, here, c, link, carrier)
            active = is_active(here, depth, v)
            if block.any_of(active):
                depth = active * depth  # 0 on inactive spheres, and so is their force
                fc = contact_force(here, depth, v)
                f = vec3(fc[0], fc[1], fc[2])
                g_f = in_frame(E, -active * point_velocity(node.W, p))
                a = vec3()
                hi = T(0.0)
                if wp.static(IMPLICIT):
                    hi = here.h
                    a = in_frame(E, point_velocity(node.A, p) + vec3(m.gravity))
                    B = active * contact_resistance(here, depth, fc[3])
                    f = f - wp.cw_mul(B, a)
                g = contact_adjoint(here, depth, v, a, g_f, hi)
                g_v = vec3(g[0], g[1], g[2])
                if wp.static(TERRAIN):
                    g_turn = wp.cross(g_v, v)[1] - wp.cross(g_f, f)[1]  # adjoint of the angle of E
                f = in_world(E, f)
                g_v = in_world(E, g_v)
                wrench = force_at(p, f)
                G = force_at(p, g_v)
                g_p = in_world(E, vec3(T(0.0), T(0.0), g[3]))
                g_p = g_p + wp.cross(g_v, wp.spatial_top(link.V)) - wp.cross(f, wp.spatial_top(node.W))
                if wp.static(IMPLICIT):
                    g_a = -wp.cw_mul(B, g_f)
                    if wp.static(TERRAIN):
                        g_turn = g_turn + wp.cross(g_a, a)[1]
                    g_a = in_world(E, g_a)
                    GA = force_at(p, g_a)
                    g_p = g_p + wp.cross(g_a, wp.spatial_top(node.A))
                    adj.a = adj.a + GA
                    adj.v = adj.v + wp.spatial_cross_dual(link.V, GA)
                    adj.p = adj.p + wp.spatial_cross_dual(node.A, GA)
                adj.w = adj.w - wrench
                adj.v = adj.v + G
                # The lowest point follows the sphere's centre, not the body's material.
                radius = T(m.contact_radius[c])
                if wp.static(TERRAIN):
                    tangent = E * vec3(T(1.0), T(0.0), T(0.0))
                    g_p = g_p + curvature * (g_turn - radius * wp.dot(tangent, g_p)) * tangent
                adj.p = adj.p + force_at(p + in_world(E, vec3(T(0.0), T(0.0), radius)), g_p)
                adj.p = adj.p + wp.spatial_cross_dual(link.V, G) - wp.spatial_cross_dual(node.W, wrench)
        return adj

    return functions(locals())

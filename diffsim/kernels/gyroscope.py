"""Gyroscopic forces of free bodies, implicit in the velocity, as those of MuJoCo 4's implicitfast.

After the constraints' acceleration a, damping b and these forces act on the velocity at the end of the step, so that
its acceleration x satisfies the six equations of a body without joints

    (M + h b + h B) x = M a,   B x = w x* I x + x x* I w,

with the body's spin w, and of x in B the angular part: B is the derivative of the bias force w x* I w. All twists are
about the joint, where the tree has its origin (kinematics.py). B is not symmetric, so this solve is one of its own.

The adjoint has mu, the solution with the transpose and -h g in place of M a. It adds B' mu to the gradient of a, as
damping adds b mu (solve.py), and the derivatives of h mu . B x by the spin and by what turns with the body.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.parameters import parameter_adjoint
from diffsim.kernels.thread.columns import LINK
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.tree.link import link_law


@cache
def gyroscope(spec: KernelSpec) -> SimpleNamespace:
    """Make the solves of free bodies, and what they add to the adjoint."""
    t, sp, link, joint = types(spec), spatial(spec), link_law(spec), joint_law(spec)
    T, vec3, vec6, mat3, Model, Lane, Link = t.T, t.vec3, t.vec6, t.mat3, t.Model, t.Lane, t.Link
    Links, Motions, Nodes, Root, Base, Array = t.Links, t.Motions, t.Nodes, t.Root, t.Base, t.Ts
    join, momentum, top, bottom = sp.join, sp.momentum, wp.spatial_top, wp.spatial_bottom
    FLOATING, VARIED, LEARNED = spec.floating, spec.varied, spec.parameters > 0
    add_product = parameter_adjoint(spec).add_product

    @wp.func
    def inertia_of(m: Model, here: Lane, k: int, body: Link):
        """Return a body's mass, centre of mass and inertia about that."""
        com, inertia = link.world_inertia(m, k, body)
        mass = T(m.mass[k])
        if wp.static(VARIED):
            inertia = here.mass * inertia
            mass = here.mass * mass
        return mass, com, inertia

    @wp.func
    def spin_of(V: vec6):
        """Return the angular part of a twist."""
        return join(top(V), vec3())

    @wp.func
    def apply_bias(mass: T, com: vec3, inertia: mat3, w: vec6, x: vec6):
        """Return B x, which is symmetric in the spins w and x."""
        bias = wp.spatial_cross_dual(w, momentum(mass, com, inertia, x))
        return bias + wp.spatial_cross_dual(x, momentum(mass, com, inertia, w))

    @wp.func
    def apply_transpose(mass: T, com: vec3, inertia: mat3, w: vec6, mu: vec6):
        """Return B' mu, which has an angular part only."""
        product = momentum(mass, com, inertia, wp.spatial_cross(mu, w))
        return spin_of(product - wp.spatial_cross_dual(mu, momentum(mass, com, inertia, w)))

    @wp.func
    def resistance(m: Model, here: Lane, i: int):
        """Return what a joint adds to M + h b."""
        return T(m.armature[here.at + i]) + here.h * joint.end_damping(m, here.at + i, T(1.0))

    @wp.func
    def solve_3x3(A: mat3, b: vec3):
        """Return A^-1 b by Cramer's rule."""
        x = vec3(A[0, 0], A[1, 0], A[2, 0])
        y = vec3(A[0, 1], A[1, 1], A[2, 1])
        z = vec3(A[0, 2], A[1, 2], A[2, 2])
        yz = wp.cross(y, z)
        return vec3(wp.dot(yz, b), wp.dot(wp.cross(z, x), b), wp.dot(wp.cross(x, y), b)) / wp.dot(yz, x)

    @wp.func
    def solve(m: Model, here: Lane, i: int, links: Links, transposed: bool, b: vec6):
        """Return (M + h b + h B)^-1 b, or by the transpose."""
        mass, com, inertia = inertia_of(m, here, here.at + i, links[i])
        w = top(links[i].V)
        along = vec3(mass, mass, mass)
        about = mat3()
        if wp.static(FLOATING):  # whose armature is part of the mass
            hb = here.h * T(m.base_damping)
            along = along + vec3(hb, hb, hb)
            about = wp.diag(vec3(hb, hb, hb))
        else:
            for r in range(3):
                along[r] = along[r] + resistance(m, here, i - 5 + r)
                axis = top(links[i - r].S)
                about = about + resistance(m, here, i - r) * wp.outer(axis, axis)
        moment = mass * wp.skew(com)
        turning = inertia - moment * wp.skew(com)
        right = -moment - here.h * (wp.skew(mass * wp.cross(w, com)) + wp.skew(w) * moment)
        angular = turning + about
        angular = angular + here.h * (wp.skew(w) * turning - wp.skew(turning * w))
        left = moment
        if transposed:
            angular = wp.transpose(angular)
            left = wp.transpose(right)
            right = wp.transpose(moment)
        y = wp.cw_div(bottom(b), along)
        inv = wp.diag(wp.cw_div(vec3(T(1.0), T(1.0), T(1.0)), along))
        x = solve_3x3(angular - left * inv * right, top(b) - left * y)
        return join(x, y - inv * (right * x))

    @wp.func
    def correct_change(m: Model, here: Lane, links: Links, motions: Motions, root: Root):
        """Set the change of free bodies' accelerations by damping to that with gyroscopic forces."""
        for s in range(m.free_body.shape[0]):
            i = m.free_body[s]
            a = vec6()
            b = vec6()
            if wp.static(FLOATING):
                a = join(links[0].R * root.newton_wdot, root.newton_vdot)
                b = T(m.base_damping) * a
            else:
                for r in range(6):
                    own = links[i - r].S * motions[i - r].accel_joint
                    a = a + own
                    b = b + joint.end_damping(m, here.at + i - r, T(1.0)) * own
            mass, com, inertia = inertia_of(m, here, here.at + i, links[i])
            b = b + apply_bias(mass, com, inertia, spin_of(links[i].V), spin_of(a))
            change = solve(m, here, i, links, False, -here.h * b)
            if wp.static(FLOATING):
                root.wdot = wp.transpose(links[0].R) * top(change)
                root.vdot = bottom(change)
            else:
                for r in range(6):
                    motions[i - r].u = wp.dot(links[i - r].S, change)
        return root

    @wp.func
    def correct_lambda(m: Model, here: Lane, links: Links, nodes: Nodes, g_base: vec6):
        """Set lambda of free bodies, and the twists under it, to mu."""
        for s in range(m.free_body.shape[0]):
            i = m.free_body[s]
            g = g_base
            if wp.static(not FLOATING):
                for r in range(6):
                    g = g + links[i - r].S * nodes[i - r].g
            mu = solve(m, here, i, links, True, -here.h * g)
            if wp.static(FLOATING):
                nodes[0].W = mu
            else:
                for r in range(6):
                    j = i - 5 + r
                    nodes[j].lam = wp.dot(links[j].S, mu)
                    nodes[j].W = nodes[m.parent[here.at + j]].W + links[j].S * nodes[j].lam

    @wp.func
    def add_transpose(m: Model, here: Lane, links: Links, nodes: Nodes, g_base: vec6):
        """Add B' mu to the right-hand side of the second solve; returns the base's."""
        for s in range(m.free_body.shape[0]):
            i = m.free_body[s]
            mass, com, inertia = inertia_of(m, here, here.at + i, links[i])
            g = apply_transpose(mass, com, inertia, spin_of(links[i].V), nodes[i].W)
            if wp.static(FLOATING):
                g_base = g_base + g
            else:
                for r in range(3):
                    nodes[i - r].g = nodes[i - r].g + wp.dot(links[i - r].S, g)
        return g_base

    @wp.func
    def add_adjoint(m: Model, here: Lane, links: Links, nodes: Nodes, base: Base, columns: Array):
        """Add the derivatives of h mu . B x to the gradients of joints and parameters; returns the base's."""
        for s in range(m.free_body.shape[0]):
            i = m.free_body[s]
            mass, com, inertia = inertia_of(m, here, here.at + i, links[i])
            w = spin_of(links[i].V)
            x = spin_of(nodes[i].B + nodes[i].D)
            mu = here.h * nodes[i].W1
            g_spin = top(apply_transpose(mass, com, inertia, x, mu))
            # Turning all but mu's linear part leaves the product unchanged.
            force = bottom(apply_bias(mass, com, inertia, w, x))
            g_turn = wp.cross(force, bottom(mu))
            if wp.static(FLOATING):
                base.gw = base.gw + wp.transpose(links[0].R) * g_spin
                base.gr = base.gr + wp.transpose(links[0].R) * g_turn
            else:
                for r in range(3):
                    axis = top(links[i - r].S)
                    nodes[i - r].gqd = nodes[i - r].gqd + wp.dot(axis, g_spin)
                    nodes[i - r].gq = nodes[i - r].gq + wp.dot(axis, g_turn)
            if wp.static(LEARNED):
                add_product(columns, LINK * i, links[i], wp.spatial_cross(mu, w), x)
                add_product(columns, LINK * i, links[i], wp.spatial_cross(mu, x), w)
        return base

    return functions(locals())

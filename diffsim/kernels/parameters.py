"""Gradients by a scene's constants: of links, joints, motors and contacts, as diffsim/parameters.py asks for.

In phi (backward.py) a link has W . (I a + v x* I v), and W1 . I D where damping follows the constraints. These are
linear in the link's mass, first moments and moments of inertia about its origin. With x and y the twists about it,

    x . I y = m x_l . y_l + h . (y_l x x_a + x_l x y_a) + x_a . I y_a,

and W . v x* I v = (W x v) . I v. A joint has lambda (armature a - force), a contact -f . w. Forces of constraints are
proportional to D, and so to the inverse of the inverse weight, of which the columns hold the logarithm.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.joint import joint_law
from diffsim.kernels.mujoco.limits import joint_limits
from diffsim.kernels.thread.columns import ARMATURE, DAMPING, JOINT, LINK, LOSS, MOTOR, SERVO_DAMPING, STIFFNESS, WEIGHT
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.kinematics import kinematics


@cache
def parameter_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the gradients by the constants of links, joints and motors."""
    t, sp, kin, joint, block = types(spec), spatial(spec), kinematics(spec), joint_law(spec), blocks(spec)
    T, vec3, vec6, mat3, Model, Lane, Ck, Array = t.T, t.vec3, t.vec6, t.mat3, t.Model, t.Lane, t.Checkpoint, t.Ts
    Link, Node, pick, load = t.Link, t.Node, block.pick, kin.load
    limits = joint_limits(spec) if spec.constrained else None
    LIMIT, FRICTIONLOSS, CLAMP, DRIVEN, EXPLICIT_SERVOS = spec.has("limit frictionloss clamp motor explicit_servos")
    LIMIT, CONSTRAINED, DAMPED, IMPLICIT = LIMIT and spec.constrained, spec.constrained, spec.damped, spec.implicit
    FIRST, VADR, NV, NU = 0 if spec.floating else 1, spec.dof0 - 1, spec.nv, spec.nu
    JOINTS, MOTORS = spec.columns.joints, spec.columns.motors  # links' columns come first

    @wp.func
    def add(columns: Array, k: int, value: T):
        """Add a value to a column."""
        columns[k] = columns[k] + value

    @wp.func
    def add_product(columns: Array, k: int, link: Link, x: vec6, y: vec6):
        """Add the derivatives of x . I y; x and y are about the carrier."""
        R = wp.transpose(link.R)
        xa = R * wp.spatial_top(x)
        ya = R * wp.spatial_top(y)
        xl = R * sp.point_velocity(x, link.x)
        yl = R * sp.point_velocity(y, link.x)
        first = wp.cross(yl, xa) + wp.cross(xl, ya)
        add(columns, k, wp.dot(xl, yl))
        for r in range(3):
            add(columns, k + 1 + r, first[r])
            add(columns, k + 4 + r, xa[r] * ya[r])
        add(columns, k + 7, xa[0] * ya[1] + xa[1] * ya[0])
        add(columns, k + 8, xa[0] * ya[2] + xa[2] * ya[0])
        add(columns, k + 9, xa[1] * ya[2] + xa[2] * ya[1])

    @wp.func
    def add_joint(m: Model, here: Lane, i: int, ck: Ck, link: Link, own: Node, parent: Node, columns: Array):
        """Add the derivatives of joint i's part of phi."""
        k = JOINTS + JOINT * i
        lam = own.lam
        qdd = load(ck.a, here.row, int(CONSTRAINED) * NV + VADR + i, here.e)
        unclamped = T(1.0)
        if wp.static(CLAMP):
            unclamped = own.unclamped
        force = lam * link.qd  # of a damper of 1, with the sign of phi
        if wp.static(IMPLICIT):
            force = force + here.h * lam * qdd
        inertial = lam * qdd
        servo = unclamped * force
        if wp.static(DAMPED):  # the second solve: (M + h b) change + h b qacc = 0
            lam1 = wp.dot(link.S, own.W1 - parent.W1) / wp.dot(link.S, link.S)
            end = load(ck.a, here.row, VADR + i, here.e)
            inertial = inertial + lam1 * (end - qdd)
            force = force + here.h * lam1 * end
            if wp.static(not EXPLICIT_SERVOS):
                servo = unclamped * force
        add(columns, k + ARMATURE, inertial)
        add(columns, k + DAMPING, force)
        add(columns, k + STIFFNESS, unclamped * lam * link.q)
        add(columns, k + SERVO_DAMPING, servo)
        if wp.static(LIMIT):
            limit = limits.limit_state(m, here, i, link.q, link.qd)
            jar = limit[2] * qdd + limit[1]
            add(columns, k + WEIGHT, -lam * limit[2] * pick(jar, T(0.0), limit[0], T(0.0)) * jar)
        if wp.static(FRICTIONLOSS):
            loss = m.joint_loss[i]
            f = -T(loss[1]) * (qdd + T(loss[2]) * link.qd)
            slides = pick(T(loss[0]), wp.abs(f), T(1.0), T(0.0))
            add(columns, k + LOSS, -lam * slides * pick(f, T(0.0), T(-1.0), T(1.0)))
            add(columns, k + WEIGHT, lam * (T(1.0) - slides) * f)

    @wp.func
    def add_parameters(m: Model, here: Lane, ck: Ck, links: t.Links, nodes: t.Nodes, ctrl: t.array2, columns: Array):
        """Add the derivatives of phi, without those of contacts: ground.add_contacts_adjoint has these."""
        for i in range(FIRST, here.n):
            add_product(columns, LINK * i, links[i], nodes[i].W, nodes[i].A)
            add_product(columns, LINK * i, links[i], wp.spatial_cross(nodes[i].W, links[i].V), links[i].V)
            if wp.static(DAMPED):
                add_product(columns, LINK * i, links[i], nodes[i].W1, nodes[i].D)
        for i in range(1, here.n):
            add_joint(m, here, i, ck, links[i], nodes[i], nodes[m.parent[i]], columns)
        if wp.static(DRIVEN):
            for k in range(NU):
                i = m.motor_slot[k]
                push = -nodes[i].lam
                if wp.static(CLAMP):
                    push = nodes[i].unclamped * push
                if i > 0:
                    add(columns, MOTORS + MOTOR * k, push * block.read(ctrl, here.e, k))
                    add(columns, MOTORS + MOTOR * k + 1, push)

    return functions(locals())

"""MuJoCo's regularised constraints: contact in the elliptic cone, joint limits and dry friction, and their adjoints.

A row of MuJoCo's constraints has a force that depends on the acceleration a of the robot by

    jar = J a + b v + k d(r) r,   D = d(r) / ((1 - d(r)) w),

with v the row's velocity, r < 0 how far it is beyond its margin, d(r) its impedance (`solimp`), k and b from `solref`,
w its inverse weight. MuJoCo leaves dJ/dt v out of J a, so it is that of the twists B that links would have if the joint
rates were their accelerations. A limit pushes with -D jar where jar < 0, dry friction with -D jar bounded by +-eta, a
contact with the three numbers of `cone`. All are linear in a within their zones, with slope -H. So Newton's step of
MuJoCo's convex problem,

    (M + J'HJ) (a_new - a) = tau + J'f(a) - M a,

is one pass of the articulated-body algorithm with each contact's block X'HX added to its link's inertia, and D to its
joint's: `add_contacts` and `joint_constraint`.

On a terrain (terrain.py) a contact's law and its adjoint act in the frame E of the feature that the sphere touches.

The adjoint begins at phi = -f . w with w the velocity of the point under lambda: `add_contacts_adjoint`.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.factors import K_D, K_N, MU
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.model import functions, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.terrain import terrain_contact
from diffsim.kernels.wide import blocks


@cache
def constraint_law(spec: KernelSpec) -> SimpleNamespace:
    t, sp, block = types(spec), spatial(spec), blocks(spec)
    T, U, vec2, vec3, vec4, vec6, mat3 = t.T, t.U, t.vec2, t.vec3, t.vec4, t.vec6, t.mat3
    Numbers, force_at, point_velocity, pick = t.scene.vec11, sp.force_at, sp.point_velocity, block.pick
    Model, Link, Load, Lane, NV, kin = t.Model, t.Link, t.Load, t.Lane, spec.nv, kinematics(spec)
    Place, Frame, ground, TERRAIN = t.Place, t.Frame, terrain_contact(spec), "terrain" in spec.features
    in_frame, in_world = ground.in_frame, ground.in_world
    LIMIT, LOSS, VARIED = "limit" in spec.features, "frictionloss" in spec.features, spec.varied

    @wp.func
    def row(c: Numbers, stiffness: T, r: T):
        """(D, D' / D, k d r, (k d r)'), primes with respect to r <= 0; stiffness is a factor of k."""
        x = wp.min(-r / T(c[7]), T(1.0))
        middle, power = T(c[8]), T(c[9])
        if c[9] == U(2.0):
            low = x * x / middle
            low_slope = T(2.0) * x / middle
            high = T(1.0) - (T(1.0) - x) * (T(1.0) - x) / (T(1.0) - middle)
            high_slope = T(2.0) * (T(1.0) - x) / (T(1.0) - middle)
        else:
            low_slope = power * wp.pow(x / middle, power - T(1.0))
            high_slope = power * wp.pow((T(1.0) - x) / (T(1.0) - middle), power - T(1.0))
            low = low_slope * x / power
            high = T(1.0) - high_slope * (T(1.0) - x) / power
        rise = T(c[6]) - T(c[5])
        d = T(c[5]) + rise * pick(middle, x, high, low)
        slope = -rise / T(c[7]) * pick(x, T(1.0), pick(middle, x, high_slope, low_slope), T(0.0))
        k = stiffness * T(c[0])
        rest = T(1.0) - d
        return vec4(d / (rest * T(c[4])), slope / (d * rest), k * d * r, k * (d + slope * r))

    @wp.func
    def cone(D: T, friction: T, squash: T, jar: vec3, stuck: T):
        """Force of a contact, and the matrix H of minus its derivatives; squash is 1 / impratio.

        Where stuck is 1 it is as if it stuck, however it does.
        """
        normal = jar[2]
        slip = wp.sqrt(jar[0] * jar[0] + jar[1] * jar[1])
        sticks = wp.max(stuck, pick(slip, -friction * squash * normal, T(1.0), T(0.0)))
        slides = wp.max(pick(normal, friction * slip, T(1.0), T(0.0)) - sticks, T(0.0))
        Dn = sticks * D
        Dt = Dn / squash
        Ds = slides * D / (T(1.0) + friction * friction * squash)
        over = normal - friction * slip
        inverse = pick(T(0.0), slip, T(1.0) / slip, T(0.0))
        tx = inverse * jar[0]
        ty = inverse * jar[1]
        across = Dt - Ds * over * friction * inverse
        along = Ds * friction * friction - (across - Dt)
        nx = -Ds * friction * tx
        ny = -Ds * friction * ty
        xy = along * tx * ty
        f = vec3(-across * jar[0], -across * jar[1], -Dn * normal - Ds * over)
        H = mat3(across + along * tx * tx, xy, nx, xy, across + along * ty * ty, ny, nx, ny, Dn + Ds)
        return f, H

    @wp.func
    def by_friction(D: T, friction: T, squash: T, jar: vec3, w: vec3):
        """w . df / d friction; only what slides depends on it."""
        slip = wp.sqrt(jar[0] * jar[0] + jar[1] * jar[1])
        sticks = pick(slip, -friction * squash * jar[2], T(1.0), T(0.0))
        slides = pick(jar[2], friction * slip, T(1.0), T(0.0)) - sticks
        inverse = pick(T(0.0), slip, T(1.0) / slip, T(0.0))
        mu2 = T(1.0) + friction * friction * squash
        Ds = slides * D / mu2
        over = jar[2] - friction * slip
        change = Ds * (T(2.0) * friction * squash / mu2 * over + slip)  # of the normal force
        along = inverse * (jar[0] * w[0] + jar[1] * w[1])
        return change * w[2] + (Ds * over - friction * change) * along

    @wp.func
    def place(m: Model, here: Lane, c: int, link: Link, carrier: Place):
        """Centre of contact sphere c, its distance from the ground, 1 where that is within its margin, else 0; the
        frame of the contact, and the ground's curvature in it."""
        centre = sp.on_link(link.R, link.x, m.contact_position[c])
        reach = T(m.contact_radius[c] + m.contact_numbers[c][10])
        distance, E, curvature = ground.distance(m, here, c, centre, carrier, reach)
        return centre, distance, pick(distance, T(m.contact_numbers[c][10]), T(1.0), T(0.0)), E, curvature

    @wp.func
    def constants(m: Model, here: Lane, c: int):
        """(stiffness, damping, friction) of contact sphere c."""
        numbers = m.contact_numbers[c]
        if wp.static(VARIED):
            return vec3(here.k_n, wp.sqrt(here.k_n) * T(numbers[1]), here.mu * T(numbers[2]))
        return vec3(T(1.0), T(numbers[1]), T(numbers[2]))

    @wp.func
    def contact_state(m: Model, here: Lane, c: int, centre: vec3, distance: T, on: T, E: Frame, V: vec6, B: vec6):
        """MuJoCo's contact point, jar, what row and what constants return; D is 0 where the sphere does not touch."""
        numbers = m.contact_numbers[c]
        # The point lies in the middle between the two surfaces.
        p = centre - in_world(E, vec3(T(0.0), T(0.0), T(m.contact_radius[c]) + T(0.5) * distance))
        of = constants(m, here, c)
        state = row(numbers, of[0], wp.min(distance - T(numbers[10]), T(0.0)))
        jar = in_frame(E, point_velocity(B, p) + of[1] * point_velocity(V, p)) + vec3(T(0.0), T(0.0), state[2])
        D = on * state[0]
        if wp.static(VARIED):
            D = here.k_d * D
        return p, jar, vec4(D, state[1], state[2], state[3]), of

    @wp.func
    def touch(m: Model, here: Lane, links: t.Links, carrier: Place, touches: t.Contacts):
        """The contacts of a lane at the start of a substep, without acceleration.

        They are linear about where they were in the last substep, and stick if they did not touch there.
        """
        first = m.contact_begin[here.at]
        for i in range(here.n):
            for c in range(m.contact_begin[here.at + i], m.contact_begin[here.at + i + 1]):
                s = c - first
                centre, distance, on, E, _ = place(m, here, c, links[i], carrier)
                stuck = T(1.0) - on * touches[s].on
                touches[s].on = on
                if block.any_of(on):
                    p, jar, state, of = contact_state(m, here, c, centre, distance, on, E, links[i].V, vec6())
                    was = vec3()
                    for r in range(3):
                        was[r] = pick(T(0.0), stuck, jar[r], touches[s].jar[r])
                    f, H = cone(state[0], of[2], T(m.contact_numbers[c][3]), was, stuck)
                    touches[s].p = p
                    touches[s].jar = jar
                    touches[s].D = state[0]
                    touches[s].f = f + H * (was - jar)
                    touches[s].H = H
                    if wp.static(TERRAIN):
                        touches[s].E = E

    @wp.func
    def add_contacts(m: Model, here: Lane, k: int, touches: t.Contacts, load: Load):
        """The load of link k with its contacts, linear about the iterate."""
        for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
            s = c - m.contact_begin[here.at]
            if block.any_of(touches[s].on):
                p = touches[s].p
                H = touches[s].H
                f = touches[s].f
                if wp.static(TERRAIN):
                    f = touches[s].E * f
                    H = touches[s].E * H * wp.transpose(touches[s].E)
                PH = wp.skew(p) * H
                load.a = load.a - PH * wp.skew(p)
                load.b = load.b + PH
                load.d = load.d + H
                load.f = load.f - force_at(p, f)
        return load

    @wp.func
    def makes_good(less: vec3, w: T, H: mat3):
        """(1 / w + H)^-1 less, the acceleration that makes good what a force lacks; I + w H has pivots of 1 or more."""
        G = w * H
        x = w * less
        d = T(1.0) / (T(1.0) + G[0, 0])
        y = d * G[1, 0]
        z = d * G[2, 0]
        e = G[2, 1] - z * G[1, 0]
        x[1] = x[1] - y * x[0]
        x[2] = x[2] - z * x[0]
        c = T(1.0) / wp.max(T(1.0) + G[1, 1] - y * G[1, 0], T(1.0))
        v = c * e
        x[2] = (x[2] - v * x[1]) / wp.max(T(1.0) + G[2, 2] - z * G[2, 0] - v * e, T(1.0))
        x[1] = c * x[1] - v * x[2]
        x[0] = d * x[0] - y * x[1] - z * x[2]
        return x

    @wp.func
    def try_contacts(m: Model, here: Lane, k: int, step: vec6, part: T, tries: int, touches: t.Contacts):
        """Forces and slopes after a part of a step of link k's twist; their part of what newton.measure returns."""
        found = vec6()
        for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
            s = c - m.contact_begin[here.at]
            if block.any_of(touches[s].on):
                by = point_velocity(step, touches[s].p)
                if wp.static(TERRAIN):
                    by = in_frame(touches[s].E, by)
                if tries == 0:
                    touches[s].Hs = touches[s].H * by
                jar = touches[s].jar + part * by
                f, H = cone(touches[s].D, constants(m, here, c)[2], T(m.contact_numbers[c][3]), jar, T(0.0))
                less = touches[s].f - part * touches[s].Hs - f
                w = T(m.contact_numbers[c][4])
                away = makes_good(less, w, H)
                found = found + vec6(
                    wp.dot(by, less),
                    wp.dot(by, touches[s].Hs),
                    wp.dot(by, H * by),
                    wp.dot(away, away),
                    w * wp.trace(H),
                    T(0.0),
                )
                touches[s].tried = jar
                touches[s].pushes = f
                touches[s].H = H
        return found

    @wp.func
    def keep_contacts(m: Model, here: Lane, touches: t.Contacts):
        """The contacts of a lane are where they were tried last."""
        first = m.contact_begin[here.at]
        for c in range(first, m.contact_begin[here.at + here.n]):
            if block.any_of(touches[c - first].on):
                touches[c - first].jar = touches[c - first].tried
                touches[c - first].f = touches[c - first].pushes

    @wp.func
    def record_contacts(m: Model, here: Lane, ck: t.Checkpoint, touches: t.Contacts):
        """Into the checkpoint jar of all contacts of a lane, after the accelerations.

        It is a small difference of large numbers, of which float32 would not find the cone's zone again, and a factor
        of one zone does not go with forces of another.
        """
        first = m.contact_begin[here.at]
        for c in range(first, m.contact_begin[here.at + here.n]):
            for r in range(3):
                kin.store(ck.a, here.row, 2 * NV + 3 * c + r, here.e, touches[c - first].jar[r])

    @wp.func
    def add_contacts_adjoint(
        m: Model,
        here: Lane,
        k: int,
        link: Link,
        node: t.Node,
        carrier: Place,
        ck: t.Checkpoint,
        adj: t.Adjoint,
        by: t.Ts,
    ):
        """The adjoints of link k with its contacts' part of phi added; by: those of factors."""
        for c in range(m.contact_begin[k], m.contact_begin[k + 1]):
            centre, distance, on, E, curvature = place(m, here, c, link, carrier)
            if block.any_of(on):
                p, _, state, of = contact_state(m, here, c, centre, distance, on, E, link.V, node.B)
                jar = vec3()
                for r in range(3):
                    jar[r] = kin.load(ck.a, here.row, 2 * NV + 3 * c + r, here.e)
                f, H = cone(state[0], of[2], T(m.contact_numbers[c][3]), jar, T(0.0))
                w = in_frame(E, point_velocity(node.W, p))
                moves = in_frame(E, point_velocity(link.V, p))
                g_jar = H * w
                g_r = g_jar[2] * state[3] - wp.dot(f, w) * state[1]
                if wp.static(VARIED):
                    by_k = T(0.5) * of[1] * wp.dot(g_jar, moves) + g_jar[2] * state[2]
                    by_mu = by_friction(state[0], of[2], T(m.contact_numbers[c][3]), jar, w)
                    by[K_N] = by[K_N] + by_k / of[0]
                    by[K_D] = by[K_D] - wp.dot(f, w) / here.k_d
                    by[MU] = by[MU] - T(m.contact_numbers[c][2]) * by_mu
                if wp.static(TERRAIN):  # the adjoint of the frame's angle
                    turns = wp.cross(g_jar, jar - vec3(T(0.0), T(0.0), state[2]))[1] - wp.cross(f, w)[1]
                f = in_world(E, f)
                g_jar = in_world(E, g_jar)
                G = force_at(p, g_jar)
                wrench = force_at(p, f)
                g_p = wp.cross(g_jar, wp.spatial_top(node.B) + of[1] * wp.spatial_top(link.V)) - wp.cross(
                    f, wp.spatial_top(node.W)
                )
                adj.w = adj.w - wrench
                adj.v = adj.v + of[1] * G
                adj.b = adj.b + G
                # The point follows the sphere's centre, at half its speed along the normal, which turns with it.
                g_p = in_frame(E, g_p)
                g_p[2] = T(0.5) * g_p[2] + g_r
                if wp.static(TERRAIN):
                    arm = T(m.contact_radius[c]) + T(0.5) * distance
                    g_p[0] = g_p[0] + curvature * (turns - arm * g_p[0])
                adj.p = adj.p + force_at(centre, in_world(E, g_p))
                adj.p = (
                    adj.p + wp.spatial_cross_dual(of[1] * link.V + node.B, G) - wp.spatial_cross_dual(node.W, wrench)
                )
        return adj

    @wp.func
    def limit_row(m: Model, here: Lane, i: int, q: T):
        """(D or 0 within the range, D' / D, k d r, (k d r)'), and the direction in which the joint returns."""
        numbers = m.limit_numbers[i]
        low = q - T(m.lower[i])
        high = T(m.upper[i]) - q
        r = wp.min(low, high) - T(numbers[10])
        stiffness = T(1.0)
        if wp.static(VARIED):
            stiffness = here.k_limit
        state = row(numbers, stiffness, wp.min(r, T(0.0)))
        on = pick(r, T(0.0), T(1.0), T(0.0))
        return vec4(on * state[0], state[1], state[2], state[3]), pick(low, high, T(1.0), T(-1.0))

    @wp.func
    def limit_damping(m: Model, here: Lane, i: int):
        b = T(m.limit_numbers[i][1])
        if wp.static(VARIED):
            b = wp.sqrt(here.k_limit) * b
        return b

    @wp.func
    def stop(m: Model, here: Lane, i: int, q: T, qd: T):
        """Of a joint's limit (D or 0, jar without acceleration, the direction in which the joint returns)."""
        state, way = limit_row(m, here, i, q)
        return vec3(state[0], way * limit_damping(m, here, i) * qd + state[2], way)

    @wp.func
    def joint_constraint(m: Model, i: int, stop: vec3, qd: T, qdd: T, stuck: T):
        """(force of the limit and of dry friction on the joint, minus its derivative in qdd); stuck as of cone."""
        force = T(0.0)
        slope = T(0.0)
        if wp.static(LIMIT):
            jar = stop[2] * qdd + stop[1]
            slope = pick(jar, T(0.0), stop[0], stuck * stop[0])
            force = -stop[2] * slope * jar
        if wp.static(LOSS):
            loss = m.joint_loss[i]
            f = -T(loss[1]) * (qdd + T(loss[2]) * qd)
            eta = T(loss[0])
            force = force + wp.max(wp.min(f, eta), -eta)
            slope = slope + pick(wp.abs(f), eta, T(loss[1]), T(0.0))
        return vec2(force, slope)

    @wp.func
    def joint_gain(m: Model, here: Lane, i: int, q: T, qd: T, qdd: T):
        """Derivatives of that force with respect to q, qd and the factor of k_limit."""
        gain = vec3()
        if wp.static(LIMIT):
            state, way = limit_row(m, here, i, q)
            b = limit_damping(m, here, i)
            jar = way * (qdd + b * qd) + state[2]
            D = pick(jar, T(0.0), state[0], T(0.0))
            gain = -D * vec3(state[3] + jar * state[1], b, T(0.0))
            if wp.static(VARIED):
                gain[2] = -D * (T(0.5) * b * qd + way * state[2]) / here.k_limit
        if wp.static(LOSS):
            loss = m.joint_loss[i]
            f = T(loss[1]) * (qdd + T(loss[2]) * qd)
            gain[1] = gain[1] - pick(wp.abs(f), T(loss[0]), T(loss[1]) * T(loss[2]), T(0.0))
        return gain

    return functions(locals())

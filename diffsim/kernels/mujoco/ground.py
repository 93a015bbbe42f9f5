"""Contacts of spheres with the ground by MuJoCo's law (impedance.py, cone.py), and their adjoint.

On a terrain (terrain.py) a contact's law and its adjoint act in the frame E of the feature that the sphere touches.

The adjoint begins at phi = -f . w with w the velocity of the point under lambda: `add_contacts_adjoint`.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.laws.terrain import terrain_contact
from diffsim.kernels.mujoco.cone import friction_cone
from diffsim.kernels.mujoco.impedance import impedance_law
from diffsim.kernels.thread.columns import CONTACT
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.kinematics import kinematics

# All points of a lane may touch the ground at once on a CPU, a share of them on a GPU, and MOST_CONTACTS in any case. A
# GPU's compiler writes out how each element of a local array begins: for the 456 points of a G1's meshes in a minute.
MOST_CONTACTS = 64
SHARES = 1, 4  # on a CPU, whose blocks unite the contacts of environments, and on a GPU
UNSOLVED = 1e8  # square of the acceleration by which a step is wrong that lacks a contact for want of room


def contact_room(spec: KernelSpec) -> int:
    """Return how many contacts with the ground have room."""
    return max(1, min(spec.spheres, max(MOST_CONTACTS, spec.spheres // SHARES[spec.env_last])))


def pair_column(spec: KernelSpec) -> int:
    """Return the checkpoint's first column of pairs/, after accelerations and the lanes' contacts with the ground."""
    return 2 * spec.nv + 4 * contact_room(spec) * spec.threads_per_env


@cache
def ground_contact(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of contacts with the ground in Newton's method."""
    t, sp, block, kin = types(spec), spatial(spec), blocks(spec), kinematics(spec)
    T, U, vec3, vec4, vec6, mat3 = t.T, t.U, t.vec3, t.vec4, t.vec6, t.mat3
    force_at, point_velocity, pick = sp.force_at, sp.point_velocity, block.pick
    Model, Link, Load, Lane, CarrierPos, Frame = t.Model, t.Link, t.Load, t.Lane, t.CarrierPos, t.Frame
    terrain, impedance, cone = terrain_contact(spec), impedance_law(spec), friction_cone(spec)
    in_frame, in_world = terrain.in_frame, terrain.in_world
    (PYRAMID, BOX), FRAMED, VARIED = spec.has("pyramid box"), spec.framed, spec.varied
    NV, ROOM = spec.nv, contact_room(spec)

    @wp.func
    def locate_contact(m: Model, here: Lane, c: int, link: Link, carrier: CarrierPos):
        """Locate contact sphere c over the ground.

        Returns:
            its centre, its distance from the ground, 1 within its margin, else 0; the contact's frame E, and the
            ground's curvature in it.
        """
        centre = sp.on_link(link.R, link.x, m.contact_position[c])
        reach = T(m.contact_radius[c] + m.contact_params[c][10])
        distance, E, curvature = terrain.distance(m, here, c, terrain.about_carrier(link, centre), carrier, reach)
        active = pick(distance, T(m.contact_params[c][10]), T(1.0), T(0.0))
        if wp.static(BOX):  # of a box MuJoCo takes the corners of the lower half
            if m.contact_radius[c] == U(0.0):
                height = in_frame(E, link.R * vec3(m.contact_axis[c]))[2]
                active = active * pick(T(0.0), height, T(0.0), T(1.0))
        return centre, distance, active, E, curvature

    @wp.func
    def contact_constants(m: Model, here: Lane, c: int):
        """Return contact sphere c's factor of k, its b and its friction."""
        params = m.contact_params[c]
        if wp.static(VARIED):
            return vec3(here.k_n, wp.sqrt(here.k_n) * T(params[1]), here.mu * T(params[2]))
        return vec3(T(1.0), T(params[1]), T(params[2]))

    @wp.func
    def contact_state(m: Model, here: Lane, c: int, centre: vec3, distance: T, active: T, E: Frame, V: vec6, B: vec6):
        """Return MuJoCo's contact point, jar, impedance_row, with D = 0 beyond the margin, and contact_constants."""
        params = m.contact_params[c]
        # The point lies midway between the two surfaces.
        p = centre - in_world(E, vec3(T(0.0), T(0.0), T(m.contact_radius[c]) + T(0.5) * distance))
        coef = contact_constants(m, here, c)
        state = impedance.impedance_row(params, coef[0], wp.min(distance - T(params[10]), T(0.0)))
        jar = in_frame(E, point_velocity(B, p) + coef[1] * point_velocity(V, p)) + vec3(T(0.0), T(0.0), state[2])
        D = active * state[0]
        if wp.static(VARIED):
            D = here.k_d * D
        return p, jar, vec4(D, state[1], state[2], state[3]), coef

    @wp.func
    def begin_contacts(
        m: Model, here: Lane, links: t.Links, carrier: CarrierPos, motions: t.Motions, contacts: t.Contacts
    ):
        """List a lane's contacts at the start of a substep, with zero acceleration; returns their number.

        The force is linear about the last substep's jar; a new contact is in the quadratic zone.
        """
        end = wp.min(here.contacts, ROOM)
        for s in range(end):
            contacts[s].last_sphere = contacts[s].sphere
            contacts[s].last_active = contacts[s].active
            contacts[s].last_jar = contacts[s].jar
        last = int(0)
        number = int(0)
        for i in range(here.n):
            motions[i].contacts_begin = wp.min(number, ROOM)
            for c in range(m.contact_begin[here.at + i], m.contact_begin[here.at + i + 1]):
                centre, distance, active, E, _ = locate_contact(m, here, c, links[i], carrier)
                if block.any_of(active):
                    if number < ROOM:
                        s = number
                        if wp.static(PYRAMID):
                            E = E * cone.frame(cone.heading(m, c, links[i].R, E))
                        while last < end and contacts[last].last_sphere < c:
                            last = last + 1
                        sticking = T(1.0)
                        last_jar = vec3()
                        if last < end and contacts[last].last_sphere == c:
                            sticking = T(1.0) - active * contacts[last].last_active
                            last_jar = contacts[last].last_jar
                        p, jar, state, coef = contact_state(m, here, c, centre, distance, active, E, links[i].V, vec6())
                        for r in range(3):
                            last_jar[r] = pick(T(0.0), sticking, jar[r], last_jar[r])
                        f, H = cone.force(state[0], coef[2], T(m.contact_params[c][3]), last_jar, sticking)
                        contacts[s].sphere = c
                        contacts[s].active = active
                        contacts[s].p = p
                        contacts[s].jar = jar
                        contacts[s].D = state[0]
                        contacts[s].f = f + H * (last_jar - jar)
                        contacts[s].H = H
                        if wp.static(FRAMED):
                            contacts[s].E = E
                    number = number + 1
            motions[i].contacts_end = wp.min(number, ROOM)
        return number

    @wp.func
    def add_contacts(begin: int, end: int, contacts: t.Contacts, load: Load):
        """Add a link's contacts, linear about the iterate, to its load."""
        for s in range(begin, end):
            p = contacts[s].p
            H = contacts[s].H
            f = contacts[s].f
            if wp.static(FRAMED):
                f = contacts[s].E * f
                H = contacts[s].E * H * wp.transpose(contacts[s].E)
            PH = wp.skew(p) * H
            load.a = load.a - PH * wp.skew(p)
            load.b = load.b + PH
            load.d = load.d + H
            load.f = load.f - force_at(p, f)
        return load

    @wp.func
    def trial_contacts(
        m: Model, here: Lane, begin: int, end: int, step: vec6, alpha: T, evaluation: int, contacts: t.Contacts
    ):
        """Evaluate a link's contacts after the trial step alpha step; returns their Trial."""
        total = t.Trial()
        for s in range(begin, end):
            c = contacts[s].sphere
            step_jar = point_velocity(step, contacts[s].p)
            if wp.static(FRAMED):
                step_jar = in_frame(contacts[s].E, step_jar)
            if evaluation == 0:
                contacts[s].Hs = contacts[s].H * step_jar
            jar = contacts[s].jar + alpha * step_jar
            friction = contact_constants(m, here, c)[2]
            f, H = cone.force(contacts[s].D, friction, T(m.contact_params[c][3]), jar, T(0.0))
            force_error = contacts[s].f - alpha * contacts[s].Hs - f
            w = T(m.contact_params[c][4])
            accel_error = impedance.acceleration_for(force_error, w, H)
            total.slope = total.slope + wp.dot(step_jar, force_error)
            total.linear = total.linear + wp.dot(step_jar, contacts[s].Hs)
            total.curvature = total.curvature + wp.dot(step_jar, H * step_jar)
            total.error_sq = total.error_sq + wp.dot(accel_error, accel_error)
            total.stiffness = total.stiffness + w * wp.trace(H)
            contacts[s].trial_jar = jar
            contacts[s].trial_force = f
            contacts[s].H = H
        return total

    @wp.func
    def accept_contacts(begin: int, end: int, contacts: t.Contacts):
        """Accept the last trial step of contacts, with the ground or between bodies."""
        for s in range(begin, end):
            contacts[s].jar = contacts[s].trial_jar
            contacts[s].f = contacts[s].trial_force

    @wp.func
    def record_contacts(here: Lane, ck: t.Checkpoint, contacts: t.Contacts):
        """Store each of a lane's contacts in the checkpoint, after the accelerations: its sphere, and jar.

        jar is a small difference of large numbers. Recomputed in float32 it could lie in another zone of the cone,
        whose forces do not match the stored factor.
        """
        number = wp.min(here.contacts, ROOM)
        for s in range(number):
            column = 2 * NV + 4 * (ROOM * here.lane + s)
            kin.store(ck.a, here.row, column, here.e, T(float(contacts[s].sphere)))
            for r in range(3):
                kin.store(ck.a, here.row, column + 1 + r, here.e, contacts[s].jar[r])
        if number < ROOM:
            kin.store(ck.a, here.row, 2 * NV + 4 * (ROOM * here.lane + number), here.e, T(-1.0))

    return functions(locals())


@cache
def ground_adjoint(spec: KernelSpec) -> SimpleNamespace:
    """Make the adjoint of contacts with the ground, at the jar that the checkpoint has."""
    t, sp, block, kin, ground = types(spec), spatial(spec), blocks(spec), kinematics(spec), ground_contact(spec)
    T, vec3, Model, Lane, Link, CarrierPos = t.T, t.vec3, t.Model, t.Lane, t.Link, t.CarrierPos
    force_at, point_velocity = sp.force_at, sp.point_velocity
    in_frame, in_world, cone = terrain_contact(spec).in_frame, terrain_contact(spec).in_world, friction_cone(spec)
    (TERRAIN, PYRAMID), FRAMED = spec.has("terrain pyramid"), spec.framed
    NV, ROOM = spec.nv, contact_room(spec)
    LEARNED, COLUMNS = spec.parameters > 0, spec.columns.ground

    @wp.func
    def recorded_sphere(here: Lane, s: int, ck: t.Checkpoint):
        """Return the sphere of a lane's contact s in the checkpoint, -1 after the last one."""
        sphere = int(-1)
        if s < ROOM:
            sphere = int(block.element(kin.load(ck.a, here.row, 2 * NV + 4 * (ROOM * here.lane + s), here.e), 0))
        return sphere

    @wp.func
    def add_contacts_adjoint(
        # model
        m: Model,
        here: Lane,
        k: int,
        s: int,  # its first contact in the checkpoint
        # state in
        link: Link,
        node: t.Node,
        carrier: CarrierPos,
        ck: t.Checkpoint,
        # adjoints in and out
        adj: t.Adjoint,
        adj_parameters: t.Ts,
    ):
        """Add the contacts' part of phi to link k's adjoints; returns them, and the next link's first contact."""
        c = recorded_sphere(here, s, ck)
        while c >= 0 and c < m.contact_begin[k + 1]:
            centre, distance, active, feature, curvature = ground.locate_contact(m, here, c, link, carrier)
            E = feature
            if wp.static(PYRAMID):
                heading = cone.heading(m, c, link.R, feature)
                E = feature * cone.frame(heading)
            p, _, state, coef = ground.contact_state(m, here, c, centre, distance, active, E, link.V, node.B)
            jar = vec3()
            for r in range(3):
                jar[r] = kin.load(ck.a, here.row, 2 * NV + 4 * (ROOM * here.lane + s) + 1 + r, here.e)
            f, H = cone.force(state[0], coef[2], T(m.contact_params[c][3]), jar, T(0.0))
            w = in_frame(E, point_velocity(node.W, p))
            g_jar = H * w
            g_r = g_jar[2] * state[3] - wp.dot(f, w) * state[1]
            if wp.static(LEARNED):
                by_mu = cone.friction_derivative(state[0], coef[2], T(m.contact_params[c][3]), jar, w)
                adj_parameters[COLUMNS + CONTACT * c] = adj_parameters[COLUMNS + CONTACT * c] - by_mu
                adj_parameters[COLUMNS + CONTACT * c + 1] = adj_parameters[COLUMNS + CONTACT * c + 1] + wp.dot(f, w)
            if wp.static(FRAMED):  # adjoint of a rotation of the frame
                g_turn = wp.cross(g_jar, jar - vec3(T(0.0), T(0.0), state[2])) - wp.cross(f, w)
            if wp.static(PYRAMID):
                g_turn = cone.frame(heading) * g_turn
                g_heading = g_turn[2] * cone.heading_derivative(heading)
                adj.p = adj.p + sp.join(in_world(feature, g_heading), vec3())
                g_turn = g_turn - g_heading
            f = in_world(E, f)
            g_jar = in_world(E, g_jar)
            G = force_at(p, g_jar)
            wrench = force_at(p, f)
            spin = wp.spatial_top(node.B) + coef[1] * wp.spatial_top(link.V)
            g_p = wp.cross(g_jar, spin) - wp.cross(f, wp.spatial_top(node.W))
            adj.w = adj.w - wrench
            adj.v = adj.v + coef[1] * G
            adj.b = adj.b + G
            # The point follows the sphere's centre, at half its speed along the normal, which turns with it.
            g_p = in_frame(feature, g_p)
            g_p[2] = T(0.5) * g_p[2] + g_r
            if wp.static(TERRAIN):
                arm = T(m.contact_radius[c]) + T(0.5) * distance
                g_p[0] = g_p[0] + curvature * (g_turn[1] - arm * g_p[0])
            adj.p = adj.p + force_at(centre, in_world(feature, g_p))
            adj.p = adj.p + wp.spatial_cross_dual(coef[1] * link.V + node.B, G) - wp.spatial_cross_dual(node.W, wrench)
            s = s + 1
            c = recorded_sphere(here, s, ck)
        return adj, s

    return functions(locals())

"""Newton's method on MuJoCo's constraints: where its iterates are, whether they have converged, how far a step goes.

A pass of the articulated-body algorithm takes the constraints' forces for linear in the acceleration: after the step s
they are f - H s. Where they are that, the acceleration is the solution. `constrain` finds by how much they differ, as
accelerations: those of contacts times the inverse weight, those of joints over the articulated inertia.

The cost that the solution minimises is convex, with the slope s.(f - H s - f(s)) after the step. Where it rises there,
`search` goes back to where it is least.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.constraint import constraint_law
from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.joint import joint_law
from diffsim.kernels.model import by_name, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks

SEARCHES = 6  # evaluations of a line search
EDGE = 0.1  # least distance of a trial from the ends of its bracket, in multiples of its width
NEAR = 0.05  # its end: the slope in multiples of the first one
PATIENCE = 6, 2  # passes, and with dry friction, for which a whole step may end in a slope as large as the first one


@cache
def newton_method(spec: KernelSpec) -> SimpleNamespace:
    t, sums, block, constraint = types(spec), lane_sums(spec), blocks(spec), constraint_law(spec)
    T, vec3, vec4, vec6, Model, Law, Lane, pick = t.T, t.vec3, t.vec4, t.vec6, t.Model, t.Law, t.Lane, block.pick
    Links, Motions, Loads, Root, Newton = t.Links, t.Motions, t.Loads, t.Root, t.Newton
    joint, join, FLOATING = joint_law(spec), spatial(spec).join, spec.floating
    CONTACT, SHARED = "contact" in spec.features, spec.threads_per_env > 1
    HELD = bool(spec.features & {"limit", "frictionloss"})
    PATIENT = PATIENCE["frictionloss" in spec.features]
    FIRST = 0 if spec.floating else 1 + spec.inert  # the first link with inertia

    @wp.func
    def going_on(going: T, step: vec3):
        """The step where going is 1, else 0."""
        for k in range(3):
            step[k] = pick(T(0.0), going, step[k], T(0.0))
        return step

    @wp.func
    def constrain(
        m: Model,
        law: Law,
        here: Lane,
        links: t.Links,
        touches: t.Touches,
        passes: int,  # so far
        motions: t.Motions,  # of them A comes out, but that of the base in
        free_loads: t.Loads,
        loads: t.Loads,  # out
    ):
        """Loads with contacts, and forces on joints, linear about the iterate.

        Returns (the cost's slope after the last step s, s.Hs, the square of by how much the forces differ).
        """
        found = vec3()
        stuck = T(wp.where(passes == 0, 1, 0))  # as of constraint.cone
        was_stuck = T(wp.where(passes == 1, 1, 0))
        for i in range(here.n):
            k = here.at + i
            loads[i] = free_loads[i]
            if i > 0:
                p = m.parent[k]
                S = links[i].S
                motions[i].A = motions[p].A + motions[i].C + S * motions[i].rate
                motions[i].B = motions[p].B + S * motions[i].rate
                if wp.static(HELD):
                    q = links[i].q
                    qd = links[i].qd
                    held = constraint.joint_constraint(m, law, k, q, qd, motions[i].rate, stuck)
                    motions[i].held = held[0]
                    motions[i].firm = held[1]
                    if passes > 0:
                        step = motions[i].step
                        was = constraint.joint_constraint(m, law, k, q, qd, motions[i].rate - step, was_stuck)
                        less = was[0] - was[1] * step - held[0]
                        away = motions[i].dinv * less
                        found = found + T(m.carried[k]) * vec3(step * less, step * step * was[1], away * away)
            if wp.static(CONTACT):
                if i >= FIRST:
                    load, more = constraint.add_contacts(
                        m, law, here, k, motions[i].A, motions[i].B, motions[i].twist, passes, touches, loads[i]
                    )
                    loads[i] = load
                    found = found + more
        if wp.static(SHARED):
            for r in range(3):
                found[r] = sums.add(found[r])
        return found

    @wp.func
    def search(
        m: Model,
        here: Lane,
        motions: t.Motions,
        free_loads: t.Loads,
        part: T,  # of Newton's step s, that the last step is
        bracket: vec4,  # a part that is too short, the slope after it, the same of one that is too long
        patience: T,  # slope after the whole step that is let pass, in multiples of minus the first slope
        found: vec3,  # by constrain
    ):
        """(The part of the step after which the cost is least, or where that is near the one taken; its bracket).

        The slope after a part of the step is s.(f - part H s - f(part)) - (1 - part) s.(M + H)s. It grows with the
        part, so secants find where it is zero.
        """
        if block.any_of(wp.max(found[0] - patience * found[1], T(1.0) - part)):
            inertia = T(0.0)
            for i in range(here.n):
                k = here.at + i
                a = wp.spatial_top(motions[i].twist)
                l = wp.spatial_bottom(motions[i].twist)
                load = free_loads[i]
                inertia = inertia + wp.dot(a, load.a * a + T(2.0) * (load.b * l)) + wp.dot(l, load.d * l)
                if i > 0:
                    inertia = inertia + T(m.carried[k]) * T(m.armature[k]) * motions[i].step * motions[i].step
            if wp.static(SHARED):
                inertia = sums.add(inertia)
            first = (inertia + found[1]) / (part * part)
            slope = found[0] / part - (T(1.0) - part) * first
            near = T(NEAR) * first
            whole = pick(part, T(1.0), T(0.0), T(1.0))
            long = pick(pick(T(0.0), whole, patience * first, near), slope, T(1.0), T(0.0))
            short = pick(slope, -near, T(1.0) - whole, T(0.0))
            bracket[1] = pick(T(0.0), whole, -first, bracket[1])
            bracket[0] = pick(T(0.0), short, part, bracket[0])
            bracket[1] = pick(T(0.0), short, slope, bracket[1])
            bracket[2] = pick(T(0.0), long, part, bracket[2])
            bracket[3] = pick(T(0.0), long, slope, bracket[3])
            width = bracket[2] - bracket[0]
            secant = bracket[0] - width * bracket[1] / (bracket[3] - bracket[1])
            # Where the slope has a kink, secants come from one side only.
            secant = wp.max(wp.min(secant, bracket[2] - T(EDGE) * width), bracket[0] + T(EDGE) * width)
            part = pick(T(0.0), long + short, secant, part)
        return part, bracket

    @wp.func
    def begin(m: Model, law: Law, here: Lane, links: Links, motions: Motions, loads: Loads, free_loads: Loads):
        """Newton's method from no acceleration: keeps loads and forces of joints without constraints."""
        for i in range(here.n):
            k = here.at + i
            free_loads[i] = loads[i]
            motions[i].rate = T(0.0)
            motions[i].twist = vec6()
            if i > 0:
                push = joint.actuation(m, k, motions[i].motor, links[i].q, links[i].qd)
                motions[i].force = push + joint.passive_force(m, law, k, links[i].q, links[i].qd)

    @wp.func
    def linearize(
        m: Model,
        law: Law,
        here: Lane,
        links: Links,
        motions: Motions,
        touches: t.Touches,
        free_loads: Loads,
        loads: Loads,
        root: Root,
        by: Newton,
    ):
        """Loads and forces linear about the iterate, which goes back while the last step was too long."""
        part = T(1.0)
        bracket = vec4()
        again = int(1)
        while again > 0:
            motions[0].A = join(vec3(), -vec3(m.gravity))
            if wp.static(FLOATING):
                R = links[0].R
                motions[0].A = motions[0].A + join(R * root.wdot, root.vdot - wp.cross(R * root.w, root.v))
                motions[0].B = join(R * root.wdot, root.vdot)
            found = constrain(m, law, here, links, touches, by.passes, motions, free_loads, loads)
            if by.passes > 0:
                by.off = pick(T(0.0), by.going, found[2] / by.size, by.off)
            taken = part
            if by.passes > 1 and again <= SEARCHES:
                if again == 1:
                    found[0] = pick(by.tolerance * by.tolerance, by.off, by.going * found[0], T(0.0))
                patience = T(wp.where(by.passes < PATIENT, 1.0, NEAR))
                part, bracket = search(m, here, motions, free_loads, part, bracket, patience, found)
            again = again + 1
            back = part / taken - T(1.0)
            if block.any_of(wp.abs(back)):
                for i in range(here.n):
                    motions[i].rate = motions[i].rate + back * motions[i].step
                    motions[i].step = motions[i].step + back * motions[i].step
                    motions[i].twist = motions[i].twist + back * motions[i].twist
                if wp.static(FLOATING):
                    root.wdot = root.wdot + back * root.turning_up
                    root.vdot = root.vdot + back * root.speeding_up
                    root.turning_up = root.turning_up + back * root.turning_up
                    root.speeding_up = root.speeding_up + back * root.speeding_up
            else:
                again = 0
        if by.passes > 0:
            by.off = by.off + (T(1.0) - part) * (T(1.0) - part) * by.moved / by.size  # what was not taken
            by.going = pick(by.tolerance * by.tolerance, by.off, by.going, T(0.0))
        return root, by

    @wp.func
    def step_on(m: Model, here: Lane, links: Links, motions: Motions, root: Root, by: Newton):
        """A step of the iterate, where it goes on."""
        by.size = T(0.0)
        by.moved = T(0.0)
        if wp.static(FLOATING):
            root.turning_up = going_on(by.going, root.turning_up - root.wdot)
            root.speeding_up = going_on(by.going, root.speeding_up - root.vdot)
            root.wdot = root.wdot + root.turning_up
            root.vdot = root.vdot + root.speeding_up
            motions[0].twist = join(links[0].R * root.turning_up, root.speeding_up)
            by.size = T(m.carried[here.at]) * (wp.length_sq(root.wdot) + wp.length_sq(root.vdot))
            by.moved = wp.length_sq(root.turning_up) + wp.length_sq(root.speeding_up)
            by.moved = T(m.carried[here.at]) * by.moved
        for i in range(1, here.n):
            step = pick(T(0.0), by.going, motions[i].u - motions[i].rate, T(0.0))
            rate = motions[i].rate + step
            motions[i].step = step
            motions[i].rate = rate
            motions[i].twist = motions[m.parent[here.at + i]].twist + links[i].S * step
            by.size = by.size + T(m.carried[here.at + i]) * rate * rate
            by.moved = by.moved + T(m.carried[here.at + i]) * step * step
        if wp.static(SHARED):
            by.size = sums.add(by.size)
            by.moved = sums.add(by.moved)
        by.size = by.size + T(1.0)
        return root, by

    return by_name(begin, linearize, step_on)

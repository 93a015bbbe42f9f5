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
from diffsim.kernels.model import by_name, types
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks

SEARCHES = 6  # evaluations of a line search
EDGE = 0.1  # least distance of a trial from the ends of its bracket, in multiples of its width
NEAR = 0.05  # its end: the slope in multiples of the first one
PATIENCE = 6, 2  # passes, and with dry friction, for which a whole step may end in a slope as large as the first one


@cache
def newton_method(spec: KernelSpec) -> SimpleNamespace:
    t, sums, block, constraint = types(spec), lane_sums(spec), blocks(spec), constraint_law(spec)
    T, vec3, vec4, Model, Law, Lane, pick = t.T, t.vec3, t.vec4, t.Model, t.Law, t.Lane, block.pick
    CONTACT, SHARED = "contact" in spec.features, spec.threads_per_env > 1
    HELD = bool(spec.features & {"limit", "frictionloss"})
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
        C: t.vec6s,
        touches: t.Touches,
        passes: int,  # so far
        dinv: t.array,
        iterates: t.Iterates,
        free_loads: t.Loads,
        A: t.vec6s,  # out, but that of the base comes in
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
                A[i] = A[p] + C[i] + S * iterates[i].rate
                iterates[i].B = iterates[p].B + S * iterates[i].rate
                if wp.static(HELD):
                    q = links[i].q
                    qd = links[i].qd
                    held = constraint.joint_constraint(m, law, k, q, qd, iterates[i].rate, stuck)
                    iterates[i].held = held[0]
                    iterates[i].firm = held[1]
                    if passes > 0:
                        step = iterates[i].step
                        was = constraint.joint_constraint(m, law, k, q, qd, iterates[i].rate - step, was_stuck)
                        less = was[0] - was[1] * step - held[0]
                        away = dinv[i] * less
                        found = found + T(m.carried[k]) * vec3(step * less, step * step * was[1], away * away)
            if wp.static(CONTACT):
                if i >= FIRST:
                    load, more = constraint.add_contacts(
                        m, law, here, k, A[i], iterates[i].B, iterates[i].twist, passes, touches, loads[i]
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
        iterates: t.Iterates,
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
                a = wp.spatial_top(iterates[i].twist)
                l = wp.spatial_bottom(iterates[i].twist)
                load = free_loads[i]
                inertia = inertia + wp.dot(a, load.a * a + T(2.0) * (load.b * l)) + wp.dot(l, load.d * l)
                if i > 0:
                    inertia = inertia + T(m.carried[k]) * T(m.armature[k]) * iterates[i].step * iterates[i].step
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

    return by_name(going_on, constrain, search)

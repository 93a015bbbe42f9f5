"""Newton's method on MuJoCo's constraints: where its iterates are, whether they have converged, how far a step goes.

A pass of the articulated-body algorithm takes the constraints' forces for linear in the acceleration: after the step s
they are f - H s. Where they are that, the acceleration is the solution. `measure` finds by how much they differ, as
accelerations: over the inverse of the inverse weight and the slope, as the next step would.

A pass solves for the step, not for its end: on stiff ground a sum of accelerations has lost in float32 what the force
depends on. What a force depends on, and the links' accelerations, add up steps, which become small.

The cost that the solution minimises is convex, with the slope s.(f - H s - f(s)) after the step. Where it rises there,
`search` goes back to where it is least.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.constraint import constraint_law
from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.joint import joint_law
from diffsim.kernels.model import functions, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks

SEARCHES = 12  # evaluations of a line search, at most
EDGE = 0.1  # least distance of its secants from the ends of its bracket, in multiples of its width
ENOUGH = 0.1  # it ends this close to the least cost, in multiples of what the part of the step would gain at first
NEAR = 0.05  # the slope after a whole step that is good enough, in multiples of the first one
ROUND_OFF = 20.0  # of a step, in multiples of the float's epsilon and of the contacts' stiffness beside inertia
ROWS = 10.0  # by how much more an acceleration can be off than each row alone says, which other rows hold: measured
PATIENCE = 6, 2  # passes, and with dry friction, for which a whole step may end in a slope as large as the first one


@cache
def newton_method(spec: KernelSpec) -> SimpleNamespace:
    t, sums, block, constraint = types(spec), lane_sums(spec), blocks(spec), constraint_law(spec)
    T, vec3, vec4, vec6, Model, Lane, pick = t.T, t.vec3, t.vec4, t.vec6, t.Model, t.Lane, block.pick
    Links, Motions, Loads, Root, Newton = t.Links, t.Motions, t.Loads, t.Root, t.Newton
    joint, join, FLOATING = joint_law(spec), spatial(spec).join, spec.floating
    CONTACT, LIMIT, LOSS = spec.has("contact limit frictionloss")
    HELD, SHARED, PATIENT = LIMIT or LOSS, spec.threads_per_env > 1, PATIENCE[LOSS]
    ROUNDING = ROUND_OFF * (6e-8 if t.U == wp.float32 else 1.1e-16)
    FIRST = 0 if spec.floating else 1 + spec.inert  # the first link with inertia

    @wp.func
    def begin(m: Model, here: Lane, links: Links, motions: Motions, loads: Loads, free: Loads, root: Root):
        """No acceleration, where limits act as if the joints had run into them."""
        motions[0].iterate = join(vec3(), -vec3(m.gravity) - wp.cross(wp.spatial_top(links[0].V), root.v))
        for i in range(here.n):
            k = here.at + i
            free[i] = loads[i]
            motions[i].rate = T(0.0)
            if i > 0:
                q = links[i].q
                qd = links[i].qd
                motions[i].iterate = motions[m.parent[k]].iterate + motions[i].C
                motions[i].force = joint.force(m, here, k, motions[i].motor, q, qd)
                if wp.static(LIMIT):
                    motions[i].stop = constraint.stop(m, here, k, q, qd)
                if wp.static(HELD):
                    held = constraint.joint_constraint(m, k, motions[i].stop, qd, T(0.0), T(1.0))
                    motions[i].held = held[0]
                    motions[i].firm = held[1]

    @wp.func
    def linearize(m: Model, here: Lane, motions: Motions, touches: t.Contacts, free: Loads, loads: Loads):
        """Loads of the iterate, contacts included: what they and the joints' forces lack gives the next step."""
        for i in range(here.n):
            load = free[i]
            a = wp.spatial_top(motions[i].iterate)
            l = wp.spatial_bottom(motions[i].iterate)
            load.f = load.f + join(load.a * a + load.b * l, a * load.b + load.d * l)
            if wp.static(CONTACT):
                if i >= FIRST:
                    load = constraint.add_contacts(m, here, here.at + i, touches, load)
            loads[i] = load

    @wp.func
    def measure(m: Model, here: Lane, links: Links, motions: Motions, touches: t.Contacts, part: T, tries: int):
        """Constraints after a part of the step s, the first try being all of it.

        Returns (s.(f - part H s - f(part)), s.H s, s.H(part) s, the square of that difference of forces as
        acceleration, how stiff contacts are beside inertia, 0).
        """
        found = vec6()
        for i in range(here.n):
            k = here.at + i
            if wp.static(HELD):
                if i > 0:
                    step = motions[i].u
                    if tries == 0:
                        motions[i].given = motions[i].firm * step
                    rate = motions[i].rate + part * step
                    held = constraint.joint_constraint(m, k, motions[i].stop, links[i].qd, rate, T(0.0))
                    less = motions[i].held - part * motions[i].given - held[0]
                    w = T(m.limit_numbers[k][4])
                    away = w * less / (T(1.0) + w * held[1])
                    found = found + T(m.carried[k]) * vec6(
                        step * less, step * motions[i].given, step * held[1] * step, away * away, T(0.0), T(0.0)
                    )
                    motions[i].holds = held[0]
                    motions[i].firm = held[1]
            if wp.static(CONTACT):
                if i >= FIRST:
                    found = found + constraint.try_contacts(m, here, k, motions[i].A, part, tries, touches)
        if wp.static(SHARED):
            for r in range(5):
                found[r] = sums.add(found[r])
        return found

    @wp.func
    def inertia_along(m: Model, here: Lane, motions: Motions, free: Loads):
        """s.M s of the step s."""
        inertia = T(0.0)
        for i in range(here.n):
            k = here.at + i
            a = wp.spatial_top(motions[i].A)
            l = wp.spatial_bottom(motions[i].A)
            load = free[i]
            inertia = inertia + wp.dot(a, load.a * a + T(2.0) * (load.b * l)) + wp.dot(l, load.d * l)
            if i > 0:
                inertia = inertia + T(m.carried[k]) * T(m.armature[k]) * motions[i].u * motions[i].u
        if wp.static(SHARED):
            inertia = sums.add(inertia)
        return inertia

    @wp.func
    def search(part: T, bracket: vec4, first: T, slope: T, curvature: T, patience: T, tries: int):
        """The next part of the step to try, or the same one if it will do; the bracket.

        bracket: a part that is too short, the slope of the cost after it, the same of one that is too long; first:
        minus the slope before the step. The slope grows with the part.
        """
        excess = T(0.5) * slope * slope / curvature  # of the cost over its least
        over = pick(T(ENOUGH) * first * part, excess, T(1.0), T(0.0))
        whole = pick(part, T(1.0), T(0.0), T(1.0))
        over = pick(T(0.0), whole, pick(patience * first, slope, T(1.0), T(0.0)), over)
        long = pick(T(0.0), slope, over, T(0.0))
        short = over - long
        bracket[0] = pick(T(0.0), short, part, bracket[0])
        bracket[1] = pick(T(0.0), short, slope, bracket[1])
        bracket[2] = pick(T(0.0), long, part, bracket[2])
        bracket[3] = pick(T(0.0), long, slope, bracket[3])
        width = bracket[2] - bracket[0]
        # Where the slope has a kink, Newton's method leaves the bracket, and secants come from one side only.
        secant = bracket[0] - width * bracket[1] / (bracket[3] - bracket[1])
        inside = wp.max(wp.min(secant, bracket[2] - T(EDGE) * width), bracket[0] + T(EDGE) * width)
        if tries > 1:
            inside = bracket[0] + T(0.5) * width
        following = part - slope / curvature
        following = pick(bracket[0], following, pick(following, bracket[2], following, inside), inside)
        if tries == SEARCHES - 1:  # a part that lowers the cost, if one is known
            following = pick(T(0.0), bracket[0], bracket[0], following)
        return pick(T(0.0), over, following, part), bracket

    @wp.func
    def far_enough(
        m: Model, here: Lane, links: Links, motions: Motions, touches: t.Contacts, free: Loads, moved: T, by: Newton
    ):
        """The part of a step (moved: its square) after which the cost is least, or all of it if that is good enough."""
        square = by.tolerance * by.tolerance
        patience = T(wp.where(by.passes < PATIENT, 1.0, NEAR))
        part = T(1.0)
        rises = T(0.0)
        first = T(0.0)
        bracket = vec4()
        tries = int(0)
        while tries <= SEARCHES:
            found = measure(m, here, links, motions, touches, part, tries)
            rounding = T(ROUNDING) * found[4]
            away = (T(1.0) - part) * (T(1.0) - part) + rounding * rounding
            off = (T(ROWS * ROWS) * found[3] + away * moved) / by.size
            by.off = pick(T(0.0), by.going, off, by.off)
            if tries == 0 and by.passes > 0:
                rises = pick(square, off, by.going * (found[0] - patience * found[1]), T(0.0))
                if block.any_of(rises):
                    first = inertia_along(m, here, motions, free) + found[1]
                    bracket[1] = -first
            tried = part
            if tries < SEARCHES and block.any_of(rises):
                slope = found[0] - (T(1.0) - part) * first
                curvature = first - found[1] + found[2]
                following, bracket = search(part, bracket, first, slope, curvature, patience, tries)
                part = pick(T(0.0), rises, following, part)
            tries = wp.where(block.any_of(wp.abs(part - tried)), tries + 1, SEARCHES + 1)
        by.going = pick(square, by.off, by.going, T(0.0))
        return part, by

    @wp.func
    def step_on(
        m: Model, here: Lane, links: Links, motions: Motions, touches: t.Contacts, free: Loads, root: Root, by: Newton
    ):
        """A step of the iterate in its direction, u and twists, where it goes on."""
        by.size = T(0.0)
        moved = T(0.0)
        for r in range(6):
            motions[0].A[r] = pick(T(0.0), by.going, motions[0].A[r], T(0.0))
        if wp.static(FLOATING):
            for k in range(3):
                root.turning_up[k] = pick(T(0.0), by.going, root.turning_up[k], T(0.0))
                root.speeding_up[k] = pick(T(0.0), by.going, root.speeding_up[k], T(0.0))
            by.size = wp.length_sq(root.wdot + root.turning_up) + wp.length_sq(root.vdot + root.speeding_up)
            moved = wp.length_sq(root.turning_up) + wp.length_sq(root.speeding_up)
            by.size = T(m.carried[here.at]) * by.size
            moved = T(m.carried[here.at]) * moved
        for i in range(1, here.n):
            step = pick(T(0.0), by.going, motions[i].u, T(0.0))
            rate = motions[i].rate + step
            motions[i].u = step
            motions[i].A = motions[m.parent[here.at + i]].A + links[i].S * step
            by.size = by.size + T(m.carried[here.at + i]) * rate * rate
            moved = moved + T(m.carried[here.at + i]) * step * step
        if wp.static(SHARED):
            by.size = sums.add(by.size)
            moved = sums.add(moved)
        by.size = by.size + T(1.0)
        part, by = far_enough(m, here, links, motions, touches, free, moved, by)
        if wp.static(FLOATING):
            root.wdot = root.wdot + part * root.turning_up
            root.vdot = root.vdot + part * root.speeding_up
        for i in range(here.n):
            motions[i].rate = motions[i].rate + part * motions[i].u
            motions[i].iterate = motions[i].iterate + part * motions[i].A
            motions[i].held = motions[i].holds
        if wp.static(CONTACT):
            constraint.keep_contacts(m, here, touches)
        by.passes = by.passes + 1
        return root, by

    return functions(locals())

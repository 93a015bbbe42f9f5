"""The line search of Newton's method: the constraints after a trial step, and the step with the least cost.

A pass of the articulated-body algorithm linearises the constraints' forces about the iterate: after the step s they are
f - H s. `evaluate_trial` returns the difference to the true forces f(s) as an acceleration, the one by which the next
step would correct it: (1 / w + H)^-1 (f - H s - f(s)), w the inverse weight.

The cost that the solution minimises is convex, with the slope s.(f - H s - f(s)) after the step. Where the cost rises
there, `line_search` shortens the step to where it is least.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.mujoco.ground import UNSOLVED, contact_room, ground_contact
from diffsim.kernels.mujoco.impedance import impedance_law
from diffsim.kernels.mujoco.limits import joint_limits
from diffsim.kernels.pairs.rows import pair_rows
from diffsim.kernels.thread.exchange import lane_sums
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks

MAX_EVALUATIONS = 12  # evaluations of a line search
BRACKET_MARGIN = 0.1  # least distance of a secant step from the ends of the bracket, in multiples of its width
COST_TOLERANCE = 0.1  # the line search ends this close to the least cost, in multiples of alpha times the first slope
SLOPE_TOLERANCE = 0.05  # slope at which a whole step is accepted, in multiples of the first slope
ROUND_OFF = 20.0  # error of a step, in multiples of the float's epsilon and of contact stiffness over inertia
COUPLING = 10.0  # safety factor: rows couple, so the true error exceeds that of single rows by up to this (measured)
FULL_STEP_PASSES = 6, 2  # passes, and with dry friction, that accept a whole step with a slope up to the first one


@cache
def step_length(spec: KernelSpec) -> SimpleNamespace:
    """Make the line search, `line_search`."""
    t, sums, block = types(spec), lane_sums(spec), blocks(spec)
    ground, limits, add_trials = ground_contact(spec), joint_limits(spec), impedance_law(spec).add_trials
    T, vec4, Model, Lane, pick = t.T, t.vec4, t.Model, t.Lane, block.pick
    Links, Motions, Loads, Newton = t.Links, t.Motions, t.Loads, t.Newton
    CONTACT, LIMIT, LOSS = spec.has("contact limit frictionloss")
    JOINT_ROWS, SHARED, FULL_STEPS = LIMIT or LOSS, spec.threads_per_env > 1, FULL_STEP_PASSES[LOSS]
    ROUNDING = ROUND_OFF * (6e-8 if t.U == wp.float32 else 1.1e-16)
    FIRST = 0 if spec.floating else 1 + spec.inert  # the first link with inertia
    PAIRS, pairs = spec.pairs > 0, pair_rows(spec) if spec.pairs else None
    ROOM, FULL = contact_room(spec), spec.spheres > contact_room(spec)

    @wp.func
    def evaluate_trial(
        m: Model, here: Lane, links: Links, motions: Motions, contacts: t.Contacts, alpha: T, evaluation: int
    ):
        """Evaluate the constraints after the trial step alpha s; alpha is 1 in evaluation 0."""
        total = t.Trial()
        for i in range(here.n):
            k = here.at + i
            if wp.static(JOINT_ROWS):
                if i > 0:
                    step = motions[i].u
                    linear = motions[i].con_slope * step
                    accel = motions[i].accel_joint + alpha * step
                    trial = limits.joint_constraint(m, k, motions[i].limit, links[i].qd, accel, T(0.0))
                    force_error = motions[i].con_force - alpha * linear - trial[0]
                    w = T(m.limit_params[k][4])
                    accel_error = w * force_error / (T(1.0) + w * trial[1])
                    owned = T(m.owned[k])
                    total.slope = total.slope + owned * (step * force_error)
                    total.linear = total.linear + owned * (step * linear)
                    total.curvature = total.curvature + owned * (step * trial[1] * step)
                    total.error_sq = total.error_sq + owned * (accel_error * accel_error)
                    motions[i].trial_force = trial[0]
                    motions[i].trial_slope = trial[1]
            if wp.static(CONTACT):
                if i >= FIRST:
                    begin, end = motions[i].contacts_begin, motions[i].contacts_end
                    touching = ground.trial_contacts(m, here, begin, end, motions[i].A, alpha, evaluation, contacts)
                    total = add_trials(total, touching)
        if wp.static(FULL):
            total.error_sq = total.error_sq + T(wp.where(here.contacts > ROOM, UNSOLVED, 0.0))
        if wp.static(PAIRS):
            total = add_trials(total, pairs.trial(m, here, motions, alpha, contacts))
        if wp.static(SHARED):
            total.slope = sums.add(total.slope)
            total.linear = sums.add(total.linear)
            total.curvature = sums.add(total.curvature)
            total.error_sq = sums.add(total.error_sq)
            total.stiffness = sums.add(total.stiffness)
        return total

    @wp.func
    def inertia_along(m: Model, here: Lane, motions: Motions, free_loads: Loads):
        """Return s.M s of the step s."""
        inertia = T(0.0)
        for i in range(here.n):
            k = here.at + i
            a = wp.spatial_top(motions[i].A)
            l = wp.spatial_bottom(motions[i].A)
            load = free_loads[i]
            inertia = inertia + wp.dot(a, load.a * a + T(2.0) * (load.b * l)) + wp.dot(l, load.d * l)
            if i > 0:
                inertia = inertia + T(m.owned[k]) * T(m.armature[k]) * motions[i].u * motions[i].u
        if wp.static(SHARED):
            inertia = sums.add(inertia)
        return inertia

    @wp.func
    def next_trial(alpha: T, bracket: vec4, first: T, slope: T, curvature: T, slope_tolerance: T, evaluation: int):
        """Return the next step length alpha to try, or the same one if it is accepted, and the bracket.

        bracket: an alpha that is too small and the slope of the cost there, then the same of one that is too large;
        first: minus the slope at alpha = 0. The slope grows with alpha.
        """
        excess = T(0.5) * slope * slope / curvature  # of the cost over its least
        rejected = pick(T(COST_TOLERANCE) * first * alpha, excess, T(1.0), T(0.0))
        whole = pick(alpha, T(1.0), T(0.0), T(1.0))
        rejected = pick(T(0.0), whole, pick(slope_tolerance * first, slope, T(1.0), T(0.0)), rejected)
        long = pick(T(0.0), slope, rejected, T(0.0))
        short = rejected - long
        bracket[0] = pick(T(0.0), short, alpha, bracket[0])
        bracket[1] = pick(T(0.0), short, slope, bracket[1])
        bracket[2] = pick(T(0.0), long, alpha, bracket[2])
        bracket[3] = pick(T(0.0), long, slope, bracket[3])
        width = bracket[2] - bracket[0]
        # At a kink of the slope, Newton's method leaves the bracket, and secants approach from one side only.
        secant = bracket[0] - width * bracket[1] / (bracket[3] - bracket[1])
        inside = wp.max(wp.min(secant, bracket[2] - T(BRACKET_MARGIN) * width), bracket[0] + T(BRACKET_MARGIN) * width)
        if evaluation > 1:
            inside = bracket[0] + T(0.5) * width
        following = alpha - slope / curvature
        following = pick(bracket[0], following, pick(following, bracket[2], following, inside), inside)
        if evaluation == MAX_EVALUATIONS - 1:  # an alpha that lowers the cost, if one is known
            following = pick(T(0.0), bracket[0], bracket[0], following)
        return pick(T(0.0), rejected, following, alpha), bracket

    @wp.func
    def line_search(
        # model
        m: Model,
        here: Lane,
        # kinematics and inertia in
        links: Links,
        free_loads: Loads,
        # iterate and trial step, in and out
        motions: Motions,
        contacts: t.Contacts,
        step_sq: T,
        status: Newton,
    ):
        """Return the step length alpha with the least cost, or 1 if a whole step is accepted; step_sq is |s|^2."""
        tolerance_sq = status.tolerance * status.tolerance
        slope_tolerance = T(wp.where(status.passes < FULL_STEPS, 1.0, SLOPE_TOLERANCE))
        alpha = T(1.0)
        overshoots = T(0.0)
        first = T(0.0)
        bracket = vec4()
        evaluation = int(0)
        while evaluation <= MAX_EVALUATIONS:
            total = evaluate_trial(m, here, links, motions, contacts, alpha, evaluation)
            rounding = T(ROUNDING) * total.stiffness
            remaining_sq = (T(1.0) - alpha) * (T(1.0) - alpha) + rounding * rounding
            residual_sq = (T(COUPLING * COUPLING) * total.error_sq + remaining_sq * step_sq) / status.accel_sq
            status.residual_sq = pick(T(0.0), status.active, residual_sq, status.residual_sq)
            if evaluation == 0 and status.passes > 0:
                rise = status.active * (total.slope - slope_tolerance * total.linear)
                overshoots = pick(tolerance_sq, residual_sq, rise, T(0.0))
                if block.any_of(overshoots):
                    first = inertia_along(m, here, motions, free_loads) + total.linear
                    bracket[1] = -first
            last = alpha
            if evaluation < MAX_EVALUATIONS and block.any_of(overshoots):
                slope = total.slope - (T(1.0) - alpha) * first
                curvature = first - total.linear + total.curvature
                following, bracket = next_trial(alpha, bracket, first, slope, curvature, slope_tolerance, evaluation)
                alpha = pick(T(0.0), overshoots, following, alpha)
            evaluation = wp.where(block.any_of(wp.abs(alpha - last)), evaluation + 1, MAX_EVALUATIONS + 1)
        status.active = pick(tolerance_sq, status.residual_sq, status.active, T(0.0))
        return alpha, status

    return functions(locals())

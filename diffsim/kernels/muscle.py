"""Muscles, which pull along the segments of their paths, and the adjoint of the pull.

A segment runs from a point a of link i to a point b of link j, with length l and direction n from a to b. The tension T
of its muscle acts on i as the wrench T (a x n, n) and on j as the opposite one. What it adds to phi (backward.py) is
T L with L = n . w(b), the rate of length under lambda: w is the twist W_j - W_i and w(b) its velocity at b. Hence

    adj_T = L,   adj_w_j = -adj_w_i = T (a x n, n),   adj_p_j = -adj_p_i = (a x e, e) + W_i x* T (a x n, n)

with e = T/l (1 - n n') w(b); the last term turns W along with the links, as everywhere in backward.py. All is computed
in the frame of link i, where a is a constant, and for all segments between one pair of links at once. A segment shorter
than SHORTEST has no direction and pulls nothing.

linear: T = u, the maximum force times the activation. hill: T depends on the length l of the whole path and its rate,
too (hill.py); then adj_l = L dT/dl adds (a x n, n) adj_l to adj_p_j, and adj_l' = L dT/dl' is to the twists V what T is
to W.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.hill import hill_law
from diffsim.kernels.model import by_name, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks

SHORTEST = 1e-6  # m


@cache
def muscle_law(spec: KernelSpec, adjoint: bool) -> SimpleNamespace:
    t, sp, hill = types(spec), spatial(spec), hill_law(spec)
    T, vec3, vec6, Model, Law, array = t.T, t.vec3, t.vec6, t.Model, t.Law, t.array
    join, point_velocity = sp.join, sp.point_velocity
    loads_of = wp.array(dtype=t.Load)
    mat3s, vec3s, vec6s = wp.array(dtype=t.mat3), wp.array(dtype=vec3), wp.array(dtype=vec6)
    HILL, VARIED, block = "hill" in spec.features, spec.varied, blocks(spec)

    @wp.func
    def activate(m: Model, law: Law, lane: int, ctrl: t.array2, e: int, pull: array):
        """Into pull the maximum force times the activation, of each of the lane's muscles."""
        for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
            k = m.muscle[entry]
            pull[k] = T(m.gear[k]) * block.read(ctrl, e, k) + T(m.motor_bias[k])
            if wp.static(VARIED):
                pull[k] = law.motor * pull[k]

    @wp.func
    def length_of(d: vec3):
        """Of a segment; one without direction is as if infinite, so that it pulls nothing."""
        length = wp.length(d)
        return block.pick(T(SHORTEST), length, length, T(wp.inf))

    @wp.func
    def outward(R: t.mat3, x: vec3, torque: vec3, force: vec3):
        """A wrench in a link's frame, in world axes about the carrier."""
        f = R * force
        return join(R * torque + wp.cross(x, f), f)

    @wp.func
    def inward(R: t.mat3, x: vec3, v: vec6):
        """A twist about the carrier in world axes, in a link's frame."""
        return join(wp.transpose(R) * wp.spatial_top(v), wp.transpose(R) * point_velocity(v, x))

    @wp.func
    def measure(
        m: Model, lane: int, R: mat3s, x: vec3s, V: vec6s, W: vec6s, lengths: array, rates: array, powers: array
    ):
        """Length of each muscle's path, and its rates under the twists V and, in the adjoint, W."""
        for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
            k = m.muscle[entry]
            lengths[k] = T(m.hill[k][0])
            rates[k] = T(0.0)
            if wp.static(adjoint):
                powers[k] = T(0.0)
        for pair in range(m.lane_begin[lane], m.lane_begin[lane + 1]):
            i = m.pair_link[2 * pair]
            j = m.pair_link[2 * pair + 1]
            turn = wp.transpose(R[i]) * R[j]
            shift = wp.transpose(R[i]) * (x[j] - x[i])
            v = inward(R[i], x[i], V[j] - V[i])
            if wp.static(adjoint):
                w = inward(R[i], x[i], W[j] - W[i])
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                b = shift + turn * vec3(m.segment_b[s])
                d = b - vec3(m.segment_a[s])
                k = m.segment_muscle[s]
                n = d / length_of(d)
                lengths[k] = lengths[k] + wp.length(d)
                rates[k] = rates[k] + wp.dot(n, point_velocity(v, b))
                if wp.static(adjoint):
                    powers[k] = powers[k] + wp.dot(n, point_velocity(w, b))

    @wp.func
    def add_muscles(
        m: Model,
        lane: int,
        pull: array,
        tension: array,  # pull itself, unless hill
        lengths: array,
        rates: array,
        R: mat3s,
        x: vec3s,
        V: vec6s,
        loads: loads_of,
    ):
        """Adds the muscles to the links' bias forces."""
        if wp.static(HILL):
            measure(m, lane, R, x, V, V, lengths, rates, rates)
            for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                k = m.muscle[entry]
                tension[k] = hill(m, k, pull[k], lengths[k], rates[k])[0]
        for pair in range(m.lane_begin[lane], m.lane_begin[lane + 1]):
            i = m.pair_link[2 * pair]
            j = m.pair_link[2 * pair + 1]
            turn = wp.transpose(R[i]) * R[j]
            shift = wp.transpose(R[i]) * (x[j] - x[i])
            force = vec3()
            torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                d = shift + turn * vec3(m.segment_b[s]) - a
                f = d * (tension[m.segment_muscle[s]] / length_of(d))
                force = force + f
                torque = torque + wp.cross(a, f)
            wrench = outward(R[i], x[i], torque, force)
            loads[i].f = loads[i].f - wrench
            loads[j].f = loads[j].f + wrench

    @wp.func
    def add_muscles_adjoint(
        m: Model,
        lane: int,
        pull: array,
        tension: array,  # pull itself, unless hill
        g_length: array,  # L dT/dl and
        g_rate: array,  # L dT/dl' of each muscle; these two to power are of use to hill only
        path: array,
        power: array,
        R: mat3s,
        x: vec3s,
        V: vec6s,
        W: vec6s,
        adj_v: vec6s,
        adj_w: vec6s,
        adj_p: vec6s,
        adj_pull: array,
    ):
        """Adds the muscles' part of phi to the adjoints of the links and of pull."""
        if wp.static(HILL):
            measure(m, lane, R, x, V, W, path, g_rate, power)
            for entry in range(m.muscle_begin[lane], m.muscle_begin[lane + 1]):
                k = m.muscle[entry]
                curve = hill(m, k, pull[k], path[k], g_rate[k])
                tension[k] = curve[0]
                adj_pull[k] = adj_pull[k] + power[k] * curve[1]
                g_length[k] = power[k] * curve[2]
                g_rate[k] = power[k] * curve[3]
        for pair in range(m.lane_begin[lane], m.lane_begin[lane + 1]):
            i = m.pair_link[2 * pair]
            j = m.pair_link[2 * pair + 1]
            turn = wp.transpose(R[i]) * R[j]
            shift = wp.transpose(R[i]) * (x[j] - x[i])
            w = inward(R[i], x[i], W[j] - W[i])
            force = vec3()
            torque = vec3()
            place = vec3()
            place_torque = vec3()
            if wp.static(HILL):
                v = inward(R[i], x[i], V[j] - V[i])
                damp = vec3()
                damp_torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                b = shift + turn * vec3(m.segment_b[s])
                d = b - a
                length = length_of(d)
                k = m.segment_muscle[s]
                n = d / length
                f = n * tension[k]
                z = point_velocity(w, b)
                if wp.static(HILL):
                    z = z * tension[k] + point_velocity(v, b) * g_rate[k]
                    e = (z - n * wp.dot(n, z)) / length + n * g_length[k]
                    damp = damp + n * g_rate[k]
                    damp_torque = damp_torque + wp.cross(a, n * g_rate[k])
                else:
                    rate = wp.dot(n, z)
                    adj_pull[k] = adj_pull[k] + rate
                    e = (z - n * rate) * (tension[k] / length)
                force = force + f
                torque = torque + wp.cross(a, f)
                place = place + e
                place_torque = place_torque + wp.cross(a, e)
            wrench = outward(R[i], x[i], torque, force)
            gp = outward(R[i], x[i], place_torque, place) + wp.spatial_cross_dual(W[i], wrench)
            if wp.static(HILL):
                gv = outward(R[i], x[i], damp_torque, damp)
                gp = gp + wp.spatial_cross_dual(V[i], gv)
                adj_v[i] = adj_v[i] - gv
                adj_v[j] = adj_v[j] + gv
            adj_w[i] = adj_w[i] - wrench
            adj_w[j] = adj_w[j] + wrench
            adj_p[i] = adj_p[i] - gp
            adj_p[j] = adj_p[j] + gp

    return by_name(activate, add_muscles, add_muscles_adjoint)

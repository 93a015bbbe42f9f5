"""Muscles, which pull along the segments of their paths, and the adjoint of the pull.

A segment runs from a point a of link i to a point b of link j, with length l and direction n from a to b. The tension T
of its muscle acts on i as the wrench T (a x n, n) and on j as the opposite one. What it adds to phi (backward.py) is
T L with L = n . w(b), the rate of length under lambda: w is the twist W_j - W_i and w(b) its velocity at b. Hence

    adj_T = L,   adj_w_j = -adj_w_i = T (a x n, n),   adj_p_j = -adj_p_i = (a x e, e) + W_i x* T (a x n, n)

with e = T/l (1 - n n') w(b); the last term turns W along with the links, as everywhere in backward.py. All is computed
in the frame of link i, where a is a constant, and for all segments between one pair of links at once. A segment shorter
than SHORTEST has no direction and pulls nothing.

T = u, the maximum force times the activation.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import functions, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks

SHORTEST = 1e-6  # m


@cache
def muscle_law(spec: KernelSpec) -> SimpleNamespace:
    t, sp = types(spec), spatial(spec)
    T, vec3, vec6, Model, Lane, array = t.T, t.vec3, t.vec6, t.Model, t.Lane, t.Ts
    Links, Nodes, Adjoints, join, point_velocity = t.Links, t.Nodes, t.Adjoints, sp.join, sp.point_velocity
    VARIED, block = spec.varied, blocks(spec)

    @wp.func
    def activate(m: Model, here: Lane, ctrl: t.array2, pull: array):
        """Into pull the maximum force times the activation, of each of the lane's muscles."""
        for entry in range(m.muscle_begin[here.lane], m.muscle_begin[here.lane + 1]):
            k = m.muscle[entry]
            pull[k] = T(m.gear[k]) * block.read(ctrl, here.e, k) + T(m.motor_bias[k])
            if wp.static(VARIED):
                pull[k] = here.motor * pull[k]

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
    def between(m: Model, links: Links, pair: int):
        """A pair of links, and the second one's turn and place in the frame of the first."""
        i = m.pair_link[2 * pair]
        j = m.pair_link[2 * pair + 1]
        R = wp.transpose(links[i].R)
        return i, j, R * links[j].R, R * (links[j].x - links[i].x)

    @wp.func
    def add_muscles(m: Model, here: Lane, pull: array, links: Links, loads: t.Loads):
        """Adds the muscles to the links' bias forces."""
        for pair in range(m.lane_begin[here.lane], m.lane_begin[here.lane + 1]):
            i, j, turn, shift = between(m, links, pair)
            R = links[i].R
            x = links[i].x
            force = vec3()
            torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                d = shift + turn * vec3(m.segment_b[s]) - a
                f = d * (pull[m.segment_muscle[s]] / length_of(d))
                force = force + f
                torque = torque + wp.cross(a, f)
            wrench = outward(R, x, torque, force)
            loads[i].f = loads[i].f - wrench
            loads[j].f = loads[j].f + wrench

    @wp.func
    def add_muscles_adjoint(
        m: Model, here: Lane, pull: array, links: Links, nodes: Nodes, adj: Adjoints, adj_pull: array
    ):
        """Adds the muscles' part of phi to the adjoints of the links and of pull."""
        for pair in range(m.lane_begin[here.lane], m.lane_begin[here.lane + 1]):
            i, j, turn, shift = between(m, links, pair)
            R = links[i].R
            x = links[i].x
            w = inward(R, x, nodes[j].W - nodes[i].W)
            force = vec3()
            torque = vec3()
            place = vec3()
            place_torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                b = shift + turn * vec3(m.segment_b[s])
                d = b - a
                length = length_of(d)
                k = m.segment_muscle[s]
                n = d / length
                f = n * pull[k]
                z = point_velocity(w, b)
                rate = wp.dot(n, z)
                adj_pull[k] = adj_pull[k] + rate
                e = (z - n * rate) * (pull[k] / length)
                force = force + f
                torque = torque + wp.cross(a, f)
                place = place + e
                place_torque = place_torque + wp.cross(a, e)
            wrench = outward(R, x, torque, force)
            gp = outward(R, x, place_torque, place) + wp.spatial_cross_dual(nodes[i].W, wrench)
            adj[i].w = adj[i].w - wrench
            adj[j].w = adj[j].w + wrench
            adj[i].p = adj[i].p - gp
            adj[j].p = adj[j].p + gp

    return functions(locals())

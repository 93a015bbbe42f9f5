"""The tension of muscles along the segments of their paths, and its adjoint.

A segment runs from a point a of link i to a point b of link j, with length l and direction n from a to b. The tension T
of its muscle acts on i as the wrench T (a x n, n) and on j as the opposite one. What it adds to phi (backward.py) is
T L with L = n . w(b), the rate of length under lambda: w is the twist W_j - W_i and w(b) its velocity at b. Hence

    adj_T = L,   adj_w_j = -adj_w_i = T (a x n, n),   adj_p_j = -adj_p_i = (a x e, e) + W_i x* T (a x n, n)

with e = T/l (1 - n n') w(b); the last term turns W along with the links, as everywhere in backward.py. All is computed
in the frame of link i, where a is a constant, and for all segments between one pair of links at once. A segment shorter
than SHORTEST has no direction and no force.

T = u, the maximum force times the activation.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks

SHORTEST = 1e-6  # m


@cache
def muscle_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the muscles' wrenches, and their adjoint."""
    t, sp = types(spec), spatial(spec)
    T, vec3, vec6, Model, Lane, array = t.T, t.vec3, t.vec6, t.Model, t.Lane, t.Ts
    Links, Nodes, Adjoints, join, point_velocity = t.Links, t.Nodes, t.Adjoints, sp.join, sp.point_velocity
    VARIED, TREES, block = spec.varied, "trees" in spec.features, blocks(spec)

    @wp.func
    def compute_tensions(m: Model, here: Lane, ctrl: t.array2, tension: array):
        """Compute the tension of each of the lane's muscles, its maximum force times its activation."""
        for entry in range(m.muscle_begin[here.lane], m.muscle_begin[here.lane + 1]):
            k = m.muscle[entry]
            tension[k] = T(m.gear[k]) * block.read(ctrl, here.e, k) + T(m.motor_bias[k])
            if wp.static(VARIED):
                tension[k] = here.motor * tension[k]

    @wp.func
    def segment_length(d: vec3):
        """Return the length of a segment, infinite if it has no direction, so that its force is 0."""
        length = wp.length(d)
        return block.pick(T(SHORTEST), length, length, T(wp.inf))

    @wp.func
    def wrench_to_world(R: t.mat3, x: vec3, torque: vec3, force: vec3):
        """Transform a wrench from a link's frame to world axes about the carrier."""
        f = R * force
        return join(R * torque + wp.cross(x, f), f)

    @wp.func
    def twist_to_link(R: t.mat3, x: vec3, v: vec6):
        """Transform a twist from world axes about the carrier to a link's frame."""
        return join(wp.transpose(R) * wp.spatial_top(v), wp.transpose(R) * point_velocity(v, x))

    @wp.func
    def relative_pose(m: Model, links: Links, pair: int):
        """Return a pair of links, and the orientation and origin of the second in the frame of the first."""
        i = m.pair_link[2 * pair]
        j = m.pair_link[2 * pair + 1]
        R = wp.transpose(links[i].R)
        apart = links[j].x - links[i].x
        if wp.static(TREES):
            apart = apart + (links[j].origin - links[i].origin)
        return i, j, R * links[j].R, R * apart

    @wp.func
    def about_second(wrench: vec6, i: int, j: int, links: Links):
        """Return a wrench about the origin of link i's tree about that of link j's."""
        if wp.static(TREES):
            wrench = wrench + join(wp.cross(links[i].origin - links[j].origin, wp.spatial_bottom(wrench)), vec3())
        return wrench

    @wp.func
    def about_first(twist: vec6, i: int, j: int, links: Links):
        """Return a twist about the origin of link j's tree about that of link i's."""
        if wp.static(TREES):
            twist = twist + join(vec3(), wp.cross(wp.spatial_top(twist), links[i].origin - links[j].origin))
        return twist

    @wp.func
    def add_muscles(m: Model, here: Lane, tension: array, links: Links, loads: t.Loads):
        """Add the muscles to the links' bias forces."""
        for pair in range(m.lane_begin[here.lane], m.lane_begin[here.lane + 1]):
            i, j, rotation, offset = relative_pose(m, links, pair)
            R = links[i].R
            x = links[i].x
            force = vec3()
            torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                d = offset + rotation * vec3(m.segment_b[s]) - a
                f = d * (tension[m.segment_muscle[s]] / segment_length(d))
                force = force + f
                torque = torque + wp.cross(a, f)
            wrench = wrench_to_world(R, x, torque, force)
            loads[i].f = loads[i].f - wrench
            loads[j].f = loads[j].f + about_second(wrench, i, j, links)

    @wp.func
    def add_muscles_adjoint(
        m: Model, here: Lane, tension: array, links: Links, nodes: Nodes, adj: Adjoints, adj_tension: array
    ):
        """Add the muscles' part of phi to the adjoints of the links and of the tensions."""
        for pair in range(m.lane_begin[here.lane], m.lane_begin[here.lane + 1]):
            i, j, rotation, offset = relative_pose(m, links, pair)
            R = links[i].R
            x = links[i].x
            w = twist_to_link(R, x, about_first(nodes[j].W, i, j, links) - nodes[i].W)
            force = vec3()
            torque = vec3()
            g_point = vec3()
            g_point_torque = vec3()
            for s in range(m.pair_begin[pair], m.pair_begin[pair + 1]):
                a = vec3(m.segment_a[s])
                b = offset + rotation * vec3(m.segment_b[s])
                d = b - a
                length = segment_length(d)
                k = m.segment_muscle[s]
                n = d / length
                f = n * tension[k]
                velocity = point_velocity(w, b)
                rate = wp.dot(n, velocity)
                adj_tension[k] = adj_tension[k] + rate
                e = (velocity - n * rate) * (tension[k] / length)
                force = force + f
                torque = torque + wp.cross(a, f)
                g_point = g_point + e
                g_point_torque = g_point_torque + wp.cross(a, e)
            wrench = wrench_to_world(R, x, torque, force)
            gp = wrench_to_world(R, x, g_point_torque, g_point) + wp.spatial_cross_dual(nodes[i].W, wrench)
            adj[i].w = adj[i].w - wrench
            adj[j].w = adj[j].w + about_second(wrench, i, j, links)
            adj[i].p = adj[i].p - gp
            adj[j].p = adj[j].p + about_second(gp, i, j, links)

    return functions(locals())

"""External wrenches on bodies, MuJoCo's xfrc_applied, and their adjoint.

The array `forces` has six columns for each body: force f and torque in world axes at the body's centre of mass p. It
has none in kernels without forces. The wrench is constant over a control step, and p moves with the body. In phi
(backward.py) it is the term -W . wrench, with the derivatives

    d/df = -(velocity of p under W),   d/dtorque = -(angular part of W),   d/dp = -f x (angular part of W).

Both integrators evaluate the wrench at the start of a substep, like gravity: it depends on the pose only, through its
lever arm.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def external_force(spec: KernelSpec) -> SimpleNamespace:
    """Make the wrenches on bodies, and their adjoint."""
    t, sp = types(spec), spatial(spec)
    T, vec3, Model, Lane, block = t.T, t.vec3, t.Model, t.Lane, blocks(spec)
    Links, Nodes, Adjoints = t.Links, t.Nodes, t.Adjoints
    join, force_at, point_velocity, read = sp.join, sp.force_at, sp.point_velocity, block.read
    FIRST, SLOTS = 0 if spec.floating else 1, spec.slots  # a fixed base does not move

    @wp.func
    def external_wrench(forces: t.array2, e: int, body: int, p: vec3):
        """Return the force on a body, and the wrench about the carrier."""
        k = 6 * body
        f = vec3(read(forces, e, k), read(forces, e, k + 1), read(forces, e, k + 2))
        torque = vec3(read(forces, e, k + 3), read(forces, e, k + 4), read(forces, e, k + 5))
        return f, force_at(p, f) + join(torque, vec3())

    @wp.func
    def add_forces(m: Model, here: Lane, forces: t.array2, links: Links, loads: t.Loads):
        """Add the forces to the links' bias forces."""
        for i in range(FIRST, here.n):
            for entry in range(m.body_begin[here.at + i], m.body_begin[here.at + i + 1]):
                p = sp.on_link(links[i].R, links[i].x, m.body_com[entry])
                f, wrench = external_wrench(forces, here.e, m.body[entry], p)
                loads[i].f = loads[i].f - wrench

    @wp.func
    def add_forces_adjoint(
        m: Model, here: Lane, forces: t.array2, links: Links, nodes: Nodes, adj: Adjoints, adj_forces: t.vec6s
    ):
        """Add the forces' part of phi to the links' adjoints and to adj_forces, (force, torque) of each body."""
        for i in range(FIRST, here.n):
            for entry in range(m.body_begin[here.at + i], m.body_begin[here.at + i + 1]):
                body = m.body[entry]
                p = sp.on_link(links[i].R, links[i].x, m.body_com[entry])
                f, wrench = external_wrench(forces, here.e, body, p)
                W = nodes[i].W
                turn = wp.spatial_top(W)
                adj[i].w = adj[i].w - wrench
                adj[i].p = adj[i].p - force_at(p, wp.cross(f, turn)) - wp.spatial_cross_dual(W, wrench)
                adj_forces[body] = adj_forces[body] - join(point_velocity(W, p), turn)

    @wp.func
    def count_nonfinite_forces(m: Model, here: Lane, adj_forces: t.vec6s):
        """Count numbers that are not finite among the adjoints of the forces on this lane's bodies."""
        result = T(0.0)
        for entry in range(m.body_begin[here.at], m.body_begin[here.at + SLOTS]):
            for k in range(6):
                result = result + block.is_nonfinite(adj_forces[m.body[entry]][k])
        return result

    @wp.func
    def write_forces_adjoint(m: Model, here: Lane, drop: T, adj_forces: t.vec6s, g_forces: t.array2):
        """Write the gradients of the forces, and 0 where the gradient is dropped."""
        for entry in range(m.body_begin[here.at], m.body_begin[here.at + SLOTS]):
            body = m.body[entry]
            for k in range(6):
                block.write(g_forces, here.e, 6 * body + k, block.pick(drop, T(0.5), adj_forces[body][k], T(0.0)))

    return functions(locals())

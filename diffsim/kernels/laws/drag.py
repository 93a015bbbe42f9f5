"""The drag of a fluid at rest on one link, MuJoCo's inertia-box law, and its adjoint.

Drag acts on a link as on the box of uniform density that has its inertia. In the box's principal axes, with velocity l
of the centre of mass and angular velocity w, for each component,

    f = -(a l + b |l| l),   torque = -(c w + d |w| w),

with a and c the viscous drag of a sphere of the box's mean side, b and d the pressure on its faces (robot/fluid.py).

The law is invariant under a rotation of the link together with its motion. So like the inertial part of phi it has no
adjoint of the pose, only one of the velocity (backward.py). Both integrators treat it explicitly.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec


@cache
def drag_law(spec: KernelSpec) -> SimpleNamespace:
    """Make the fluid's wrench on a link, and its adjoint."""
    t, sp = types(spec), spatial(spec)
    T, vec3, vec6, mat3, Model = t.T, t.vec3, t.vec6, t.mat3, t.Model
    join, force_at, point_velocity = sp.join, sp.force_at, sp.point_velocity

    @wp.func
    def wrench(F: mat3, com: vec3, force: vec3, torque: vec3):
        """Return the wrench of a force through com and a torque, both in the box's axes F."""
        return force_at(com, F * force) + join(F * torque, vec3())

    @wp.func
    def drag_wrench(m: Model, i: int, R: mat3, com: vec3, V: vec6):
        """Return the fluid's wrench on link i, whose centre of mass is at com."""
        F = R * mat3(m.drag_frame[i])
        l = wp.transpose(F) * point_velocity(V, com)
        w = wp.transpose(F) * wp.spatial_top(V)
        f = T(m.drag_viscous[i][0]) * l + wp.cw_mul(vec3(m.drag_force[i]), wp.cw_mul(wp.abs(l), l))
        torque = T(m.drag_viscous[i][1]) * w + wp.cw_mul(vec3(m.drag_torque[i]), wp.cw_mul(wp.abs(w), w))
        return wrench(F, com, -f, -torque)

    @wp.func
    def drag_adjoint(m: Model, i: int, R: mat3, com: vec3, V: vec6, W: vec6):
        """Return the adjoint of V of -W . drag_wrench(V)."""
        F = R * mat3(m.drag_frame[i])
        l = wp.transpose(F) * point_velocity(V, com)
        w = wp.transpose(F) * wp.spatial_top(V)
        wl = wp.transpose(F) * point_velocity(W, com)
        ww = wp.transpose(F) * wp.spatial_top(W)
        g_l = T(m.drag_viscous[i][0]) * wl + T(2.0) * wp.cw_mul(vec3(m.drag_force[i]), wp.cw_mul(wp.abs(l), wl))
        g_w = T(m.drag_viscous[i][1]) * ww + T(2.0) * wp.cw_mul(vec3(m.drag_torque[i]), wp.cw_mul(wp.abs(w), ww))
        return wrench(F, com, g_l, g_w)

    return functions(locals())

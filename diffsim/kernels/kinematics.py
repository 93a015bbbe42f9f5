"""Stages that the forward and the backward kernel share: where each link is, and its contact spheres."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.model import Shape, types
from diffsim.kernels.spatial import spatial


@cache
def kinematics(shape: Shape) -> SimpleNamespace:
    t = types(shape.dtype)
    T, vec3, vec6, mat3, Model, array = shape.dtype, t.vec3, t.vec6, t.mat3, t.Model, t.array
    sp = spatial(T)
    join, point_velocity = sp.join, sp.point_velocity
    mat3s, vec3s, vec6s = wp.array(dtype=mat3), wp.array(dtype=vec3), wp.array(dtype=vec6)
    NL, CARRIER = shape.nlink, shape.carrier
    HINGE, SLIDE = "hinge" in shape.features, "slide" in shape.features
    IMPLICIT, ENV_LAST = shape.implicit, shape.env_last

    @wp.func
    def load(a: t.array3, row: int, k: int, e: int):
        if wp.static(ENV_LAST):
            return a[row, k, e]
        return a[row, e, k]

    @wp.func
    def store(a: t.array3, row: int, k: int, e: int, value: T):
        if wp.static(ENV_LAST):
            a[row, k, e] = value
        else:
            a[row, e, k] = value

    @wp.func
    def place_links(m: Model, q: array, R: mat3s, x: vec3s, S: vec6s, height: T):
        """Rotation, position relative to the carrier, and motion axis of each link; returns the carrier's height."""
        for i in range(1, NL):
            p = m.parent[i]
            a = R[p] * m.axis[i]
            if wp.static(HINGE):
                R[i] = R[p] * (m.turn0[i] + wp.sin(q[i]) * m.turn1[i] + wp.cos(q[i]) * m.turn2[i])
            else:
                R[i] = R[p] * m.turn0[i]
            xi = x[p] + R[p] * m.position[i]
            Si = join(a, wp.cross(xi, a))
            if wp.static(SLIDE):
                if m.slide[i] == 1:
                    xi = xi + a * q[i]
                    Si = join(vec3(), a)
            if wp.static(CARRIER > 0):
                # The massless slides up to the carrier move its origin: nothing reads where they are.
                if i <= CARRIER:
                    xi = vec3()
                    height = height + a[2] * q[i]
            x[i] = xi
            S[i] = Si
        return height

    @wp.func
    def sphere_state(m: Model, k: int, R: mat3, x: vec3, V: vec6, height: T, h: T, theta: T):
        """Lowest point p, its velocity, and the depth (predicted theta h ahead if implicit) of contact sphere k."""
        p = x + R * m.contact_position[k]
        depth = height + p[2] - m.contact_radius[k]
        p = p - vec3(T(0.0), T(0.0), m.contact_radius[k])
        v = point_velocity(V, p)
        if wp.static(IMPLICIT):
            depth = depth + theta * h * v[2]
        return p, v, depth

    return SimpleNamespace(load=load, store=store, place_links=place_links, sphere_state=sphere_state)

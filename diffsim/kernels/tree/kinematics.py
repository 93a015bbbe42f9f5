"""Kinematics of the links, and access to checkpoints, for the forward and the backward kernel."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def kinematics(spec: KernelSpec) -> SimpleNamespace:
    """Make the links' kinematics, and the access to numbers of checkpoints and states."""
    t = types(spec)
    T, vec2, vec3, mat3, quat, Model, Lane = t.T, t.vec2, t.vec3, t.mat3, t.quat, t.Model, t.Lane
    sp, read = spatial(spec), blocks(spec).read
    join, log_quat = sp.join, sp.log_quat
    NBALL, CARRIER, QADR = spec.nball, spec.carrier, spec.dof0 - 1 + int(spec.floating)
    BALL, STIFFNESS, HINGE, SLIDE, TERRAIN, TREES = spec.has("ball stiffness hinge slide terrain trees")
    ENV_LAST, THREADS_PER_ENV = spec.env_last, spec.threads_per_env

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
    def link_of(m: Model, k: int):
        if wp.static(THREADS_PER_ENV > 1):
            return m.link[k]
        return k

    @wp.func
    def qpos_adr(m: Model, k: int):
        if wp.static(BALL):
            return m.qpos_adr[k]
        return QADR + link_of(m, k)

    @wp.func
    def wxyz_to_quat(w: T, x: T, y: T, z: T):
        """Convert a quaternion from MuJoCo's order to Warp's."""
        return quat(x, y, z, w)

    @wp.func
    def load_quat(a: t.array2, e: int, k: int):
        return wxyz_to_quat(read(a, e, k), read(a, e, k + 1), read(a, e, k + 2), read(a, e, k + 3))

    @wp.func
    def load_quat_row(a: t.array3, row: int, k: int, e: int):
        return wxyz_to_quat(load(a, row, k, e), load(a, row, k + 1, e), load(a, row, k + 2, e), load(a, row, k + 3, e))

    @wp.func
    def place_balls(m: Model, here: Lane, ball_rot: t.quats, links: t.Links):
        """Write each ball joint's rotation into its first link's R, and its rotation vector, for springs, into q."""
        for b in range(m.ball_count[here.lane]):
            i = m.ball_slot[here.lane * NBALL + b]
            links[i].R = wp.quat_to_matrix(ball_rot[b])
            if wp.static(STIFFNESS):
                r = log_quat(ball_rot[b])
                for k in range(3):
                    links[i + k].q = r[k]

    @wp.func
    def carrier_position(m: Model, x: T, z: T):
        """Return the position of a floating base at x and z, or of a fixed base (x = z = 0), to which slides add."""
        if wp.static(TERRAIN):
            return vec2(T(m.carrier_along) + x, T(m.carrier_height) + z)
        else:
            return T(m.carrier_height) + z

    @wp.func
    def place_links(m: Model, here: Lane, links: t.Links, carrier: t.CarrierPos):
        """Compute each link's pose about the carrier, joint axis and velocity; returns the carrier's position.

        Beside other trees the link that moves_origin of its own tree takes the carrier's place.

        On entry R of a ball joint's first link is the joint's own rotation.
        """
        for i in range(1, here.n):
            k = here.at + i
            if wp.static(BALL):
                ball_rot = links[i].R
            p = m.parent[k]
            a = links[p].R * vec3(m.axis[k])
            R_joint = mat3(m.rot0[k])
            if wp.static(HINGE):
                if i > CARRIER:
                    R_joint = R_joint + wp.sin(links[i].q) * mat3(m.rot1[k]) + wp.cos(links[i].q) * mat3(m.rot2[k])
            links[i].R = links[p].R * R_joint
            if wp.static(BALL):
                if m.outboard[k] == i + 2:
                    links[i].R = links[i].R * ball_rot
                    R = links[i].R
                    a = vec3(R[0, 0], R[1, 0], R[2, 0])
            xi = links[p].x + links[p].R * vec3(m.position[k])
            Si = join(a, wp.cross(xi, a))
            if wp.static(SLIDE):
                if m.slide[k] == 1:
                    xi = xi + a * links[i].q
                    Si = join(vec3(), a)
            if wp.static(CARRIER > 0):
                # The massless slides up to the carrier move its origin. Their own position is never read.
                if i <= CARRIER:
                    xi = vec3()
                    if wp.static(TERRAIN):
                        carrier = carrier + links[i].q * vec2(a[0], a[2])
                    else:
                        carrier = carrier + a[2] * links[i].q
            if wp.static(TREES):
                links[i].origin = links[p].origin
                if m.moves_origin[k] == 1:
                    links[i].origin = links[i].origin + xi
                    xi = vec3()
                    if m.slide[k] == 0:
                        Si = join(a, vec3())
            links[i].x = xi
            links[i].S = Si
            links[i].V = links[p].V + Si * links[i].qd
        return carrier

    return functions(locals())

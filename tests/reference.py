"""The simulator once more in plain NumPy and double precision: dense, slow, and sharing no recursion with the kernels.

The mass matrix is the sum of J' I J over the links, the bias force comes from Newton's and Euler's equations at zero
joint acceleration, and the accelerations from `numpy.linalg.solve`. Vectors are in world axes.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Scene
from diffsim.sim.integration import Integration

Array = NDArray[np.float64]


@dataclasses.dataclass
class Link:
    """Motion of a link's frame: pose, velocity, Jacobians, and the accelerations that remain when qacc is zero."""

    rotation: Array  # (3, 3)
    position: Array  # (3,)
    angular_velocity: Array  # (3,)
    velocity: Array  # (3,) of the frame's origin
    angular_jacobian: Array  # (3, nv): angular_velocity = angular_jacobian @ qvel
    jacobian: Array  # (3, nv): velocity = jacobian @ qvel
    angular_bias: Array  # (3,) d/dt angular_jacobian @ qvel
    bias: Array  # (3,) d/dt jacobian @ qvel

    def point(self, offset: Array) -> tuple[Array, Array, Array]:
        """Velocity, Jacobian and bias acceleration of the material point at `offset` (world axes) from the origin."""
        w = self.angular_velocity
        return (
            self.velocity + np.cross(w, offset),
            self.jacobian + np.cross(self.angular_jacobian, offset, axisa=0, axisc=0),
            self.bias + np.cross(self.angular_bias, offset) + np.cross(w, np.cross(w, offset)),
        )


def kinematics(scene: Scene, qpos: Array, qvel: Array) -> list[Link]:
    zero, nothing = np.zeros(3), np.zeros((3, scene.nv))
    base = Link(np.eye(3), zero, zero, zero, nothing.copy(), nothing.copy(), zero, zero)
    if scene.floating:
        base.rotation = quaternion_matrix(qpos[3:7] / np.linalg.norm(qpos[3:7]))
        base.position = qpos[:3]
        base.velocity, base.jacobian[:, :3] = qvel[:3], np.eye(3)
        base.angular_velocity, base.angular_jacobian[:, 3:6] = base.rotation @ qvel[3:6], base.rotation
    links = [base]
    for i in range(1, scene.nlink):
        if scene.ball[i] > 0:
            links.append(links[-1])  # one joint of three degrees of freedom
            continue
        q, qd, dof = qpos[joint_qpos(scene, i)], qvel[joint_dof(scene, i)], joint_dof(scene, i)
        parent = links[scene.parent[i]]
        frame = parent.rotation @ scene.rotation[i]
        axis = frame @ scene.axis[i]
        offset = parent.rotation @ scene.position[i]
        if scene.slide[i]:
            offset = offset + axis * (q - scene.joint_ref[i])
        elif scene.ball[i] == 0:
            frame = frame @ quaternion_matrix(ball_quaternion(scene, i, qpos))
        else:
            frame = frame @ axis_angle_matrix(scene.axis[i], q - scene.joint_ref[i])
        velocity, jacobian, bias = parent.point(offset)
        w = parent.angular_velocity
        link = Link(
            frame,
            parent.position + offset,
            w,
            velocity,
            parent.angular_jacobian.copy(),
            jacobian,
            parent.angular_bias,
            bias,
        )
        if scene.slide[i]:
            link.velocity = velocity + axis * qd
            link.jacobian[:, dof] += axis
            link.bias = bias + 2 * np.cross(w, axis * qd)
        elif scene.ball[i] == 0:
            turn = frame @ qvel[dof : dof + 3]
            link.angular_velocity = w + turn
            link.angular_jacobian[:, dof : dof + 3] += frame
            link.angular_bias = parent.angular_bias + np.cross(w, turn)
        else:
            link.angular_velocity = w + axis * qd
            link.angular_jacobian[:, dof] += axis
            link.angular_bias = parent.angular_bias + np.cross(w, axis * qd)
        links.append(link)
    return links


def mass_and_bias(scene: Scene, links: list[Link]) -> tuple[Array, Array]:
    """(nv, nv) mass matrix and (nv,) bias force: mass @ qacc + bias = every other generalised force."""
    mass, bias = np.zeros((scene.nv, scene.nv)), np.zeros(scene.nv)
    for i, link in enumerate(links):
        w, jw = link.angular_velocity, link.angular_jacobian
        _, jc, acceleration = link.point(link.rotation @ scene.com[i])
        inertia = link.rotation @ scene.inertia[i] @ link.rotation.T
        mass += scene.mass[i] * jc.T @ jc + jw.T @ inertia @ jw
        bias += scene.mass[i] * jc.T @ (acceleration - scene.gravity)
        _, jl, _ = link.point(link.rotation @ scene.lift_position[i])
        bias += scene.lift[i] * jl.T @ scene.gravity + scene.base_damping[i] * (
            link.jacobian.T @ link.velocity + link.angular_jacobian.T @ link.angular_velocity
        )
        bias += jw.T @ (inertia @ link.angular_bias + np.cross(w, inertia @ w))
        if i > 0:
            mass[joint_dof(scene, i), joint_dof(scene, i)] += scene.armature[i]
    return mass, bias


def joint_forces(scene: Scene, qpos: Array, qvel: Array, ctrl: Array, h: float = 0.0) -> tuple[Array, Array]:
    """Motors, springs, dampers and limits (Eq. 4) at zero acceleration, and their (nv,) resistance to it."""
    force, resistance, motors = np.zeros(scene.nv), np.zeros(scene.nv), np.zeros(scene.nlink)
    resistance[: 6 * scene.floating] = h * scene.base_damping[0]
    for motor, link in enumerate(scene.motor_link):
        if link > 0:  # else it is a muscle
            motors[link] += scene.gear[motor] * ctrl[motor] + scene.motor_bias[motor]
    for i in range(1, scene.nlink):
        dof, qd = joint_dof(scene, i), qvel[joint_dof(scene, i)]
        q = joint_position(scene, i, qpos)
        servo = scene.servo_stiffness[i] * (scene.servo_ref[i] - q) - scene.servo_damping[i] * qd
        force[dof] += np.clip(motors[i] + servo, scene.force_low[i], scene.force_high[i])
        free = scene.force_low[i] < motors[i] + servo < scene.force_high[i]
        bound = np.clip(q, scene.lower[i], scene.upper[i])
        beyond = q != bound
        firmness = scene.k_limit[i] - scene.d_limit[i] * qd * np.sign(bound - q)
        pushes = beyond and firmness > 0  # it never pulls
        push = pushes * firmness * (bound - q)
        force[dof] += scene.stiffness[i] * (scene.spring_ref[i] - q) - scene.damping[i] * qd + push
        resistance[dof] = h * (scene.damping[i] + (pushes * scene.d_limit[i] * abs(bound - q) if beyond else 0.0))
        resistance[dof] += free * h * scene.servo_damping[i]
    return force, resistance


def muscle_forces(scene: Scene, links: list[Link], ctrl: Array) -> Array:
    """(nv,) the tension of every muscle, times the rate of its length that each joint rate makes."""
    slope = np.zeros((scene.nu, scene.nv))
    for (i, j), (a, b), k in zip(scene.segment_link, scene.segment_position, scene.segment_muscle, strict=True):
        (_, ja, _), (_, jb, _) = (links[n].point(links[n].rotation @ p) for n, p in ((i, a), (j, b)))
        apart = links[j].position + links[j].rotation @ b - links[i].position - links[i].rotation @ a
        if (distance := np.linalg.norm(apart)) > 0:
            slope[k] += apart / distance @ (jb - ja)
    return -(scene.gear * ctrl + scene.motor_bias) @ slope


def contact_law(scene: Scene, depth: float, velocity: Array, h: float = 0.0) -> tuple[Array, Array]:
    """Eq. 3: force on a sphere of signed depth (negative inside) whose lowest point moves so, and its resistance."""
    normal = max((scene.k_d * velocity[2] - scene.k_n) * depth, 0.0)
    if depth >= 0 or normal == 0:
        return np.zeros(3), np.zeros(3)
    slip = np.hypot(velocity[0], velocity[1])
    viscosity = min(scene.k_t * slip, scene.mu * normal) / slip if slip > 0 else scene.k_t
    force = np.array([-viscosity * velocity[0], -viscosity * velocity[1], normal])
    return force, h * np.array([viscosity, viscosity, -scene.k_d * depth])


class Touch(NamedTuple):
    link: Link
    lowest: Array  # (3,) the point of the contact sphere nearest to the ground, from the link's origin
    depth: float  # signed
    frame: Array  # (3, 3) columns: along the ground in the plane of its profile, y, the ground's normal


def touches(scene: Scene, links: list[Link], profile: int = 0) -> list[Touch]:
    """Of each contact sphere."""
    found = []
    for i, place, radius in zip(scene.contact_link, scene.contact_position, scene.contact_radius, strict=True):
        centre = links[i].rotation @ place
        x, _, z = links[i].position + centre
        depth, normal = z - radius - scene.ground_height, np.array([0.0, 1.0])
        if scene.terrain is not None:
            depth, normal = clearance(scene.terrain[profile], np.array([x, z]), radius)
        n = np.array([normal[0], 0.0, normal[1]])
        frame = np.stack([np.cross([0.0, 1.0, 0.0], n), [0.0, 1.0, 0.0], n], 1)
        found.append(Touch(links[i], centre - radius * n, depth, frame))
    return found


def clearance(vertices: Array, centre: Array, radius: float) -> tuple[float, Array]:
    """How far a disc is from touching a profile, or minus its shortest way out, and the direction (2,) away from it.

    By trying all places where the centre of a disc that touches can be nearest.
    """
    far = 1e4 * np.diff(vertices[[0, 1, -2, -1]], axis=0)[[0, 2]]
    corners = np.concatenate([vertices[:1] - far[:1], vertices, vertices[-1:] + far[1:]])
    starts, runs = corners[:-1], np.diff(corners, axis=0)
    normals = np.stack([-runs[:, 1], runs[:, 0]], 1) / np.linalg.norm(runs, axis=1, keepdims=True)

    def feet(point: Array) -> Array:
        part = ((point - starts) * runs).sum(1) / (runs**2).sum(1)
        return starts + np.clip(part, 0, 1)[:, None] * runs

    def above(point: Array) -> bool:
        right = np.searchsorted(corners[:, 0], point[0], "right")
        (a, b), (c, d) = corners[right - 1], corners[right]
        return point[1] > b + (d - b) * (point[0] - a) / (c - a)

    away = centre - feet(centre)
    distance = np.linalg.norm(away, axis=1)
    if above(centre) and distance.min() >= radius:
        nearest = distance.argmin()
        return distance[nearest] - radius, away[nearest] / distance[nearest]
    ways = [(foot - centre) + radius * n for foot, n in zip(feet(centre), normals, strict=True)]
    ways += [(way - centre) * (1 - radius / np.linalg.norm(way - centre)) for way in vertices if radius > 0]
    for v, m, n in zip(vertices, normals, normals[1:], strict=False):
        ways.append(v + radius * (m + n) / (1 + m @ n) - centre)
    ways.sort(key=lambda way: way @ way)
    for way in ways:
        end = centre + (1 + 1e-9) * way  # a hair beyond, for rounding
        if above(end) and np.linalg.norm(end - feet(end), axis=1).min() >= radius:
            return -np.linalg.norm(way), way / np.linalg.norm(way)
    raise ValueError("no way out")


def contacts(scene: Scene, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """Signed depths (nc,) and velocities (nc, 3) of the lowest points of all contact spheres."""
    found = touches(scene, kinematics(scene, qpos, qvel))
    depths = np.array([touch.depth for touch in found])
    velocities = [touch.link.point(touch.lowest)[0] for touch in found]
    return depths, np.array(velocities).reshape(-1, 3)


def acceleration(
    scene: Scene,
    qpos: Array,
    qvel: Array,
    ctrl: Array,
    h: float = 0.0,
    forces: Array | None = None,
    profile: int = 0,
) -> Array:
    """qacc of mass @ qacc = forces - bias. The implicit step has forces that are linear in it: f - resistance * a.

    h is the substep of the implicit integrator, 0 for the explicit one; profile says which environment's terrain it is.
    """
    links = kinematics(scene, qpos, qvel)
    mass, bias = mass_and_bias(scene, links)
    force, resistance = joint_forces(scene, qpos, qvel, ctrl, h)
    mass, force = mass + np.diag(resistance), force - bias
    force = force + muscle_forces(scene, links, ctrl)
    if forces is not None:
        force = force + external_forces(scene, links, forces)
    for link, lowest, depth, frame in touches(scene, links, profile):
        velocity, jacobian, drift = link.point(lowest)
        # The law acts along the ground and along its normal.
        local, jacobian = frame.T @ velocity, frame.T @ jacobian
        push, resistance = contact_law(scene, depth, local, h)
        # The law resists the change of the velocity field at a fixed place, so w x v of the moving point is not in it.
        drift = frame.T @ (drift - np.cross(link.angular_velocity, velocity))
        mass = mass + jacobian.T @ np.diag(resistance) @ jacobian
        force = force + jacobian.T @ (push - resistance * drift)
    return np.linalg.solve(mass, force + fluid_forces(scene, links))


def external_forces(scene: Scene, links: list[Link], forces: Array) -> Array:
    """(nv,) of forces and torques (nbody, 6) at the bodies' centres of mass."""
    total = np.zeros(scene.nv)
    for link, com, wrench in zip(scene.body_link, scene.body_com, forces, strict=True):
        if link >= 0:
            _, jacobian, _ = links[link].point(links[link].rotation @ com)
            total += jacobian.T @ wrench[:3] + links[link].angular_jacobian.T @ wrench[3:]
    return total


def fluid_forces(scene: Scene, links: list[Link]) -> Array:
    """(nv,) drag of the fluid: on each link that of the box of uniform density with its mass and inertia."""
    total = np.zeros(scene.nv)
    for i, link in enumerate(links):
        if scene.mass[i] == 0 or not (scene.density or scene.viscosity):
            continue
        moments, axes = np.linalg.eigh(scene.inertia[i])
        a, b, c = np.sqrt(6 * (moments.sum() - 2 * moments) / scene.mass[i])
        mean = (a + b + c) / 3
        frame = link.rotation @ axes
        velocity, jacobian, _ = link.point(link.rotation @ scene.com[i])
        l, w = frame.T @ velocity, frame.T @ link.angular_velocity
        force = -3 * np.pi * scene.viscosity * mean * l
        force -= scene.density / 2 * np.array([b * c, a * c, a * b]) * np.abs(l) * l
        torque = -np.pi * scene.viscosity * mean**3 * w
        arms = np.array([a * (b**4 + c**4), b * (a**4 + c**4), c * (a**4 + b**4)])
        torque -= scene.density / 64 * arms * np.abs(w) * w
        total += jacobian.T @ frame @ force + link.angular_jacobian.T @ frame @ torque
    return total


def integrate(scene: Scene, qpos: Array, qvel: Array, h: float) -> Array:
    """qpos after moving with qvel for h seconds, the orientation by the exact exponential."""
    result = np.zeros_like(qpos)
    if scene.floating:
        result[:3] = qpos[:3] + h * qvel[:3]
        result[3:7] = turned(qpos[3:7], h * qvel[3:6])
    for i in range(1, scene.nlink):
        adr, dof = joint_qpos(scene, i), joint_dof(scene, i)
        if scene.ball[i] < 0:
            result[adr] = qpos[adr] + h * qvel[dof]
        elif scene.ball[i] == 0:
            result[adr : adr + 4] = turned(qpos[adr : adr + 4], h * qvel[dof : dof + 3])
    return result


def turned(quaternion: Array, rotation: Array) -> Array:
    angle = np.linalg.norm(rotation)
    turn = np.array([np.cos(angle / 2), *(np.sinc(angle / (2 * np.pi)) / 2 * rotation)])
    return quaternion_product(quaternion / np.linalg.norm(quaternion), turn)


def with_factors(scene: Scene, factors: Array) -> Scene:
    """The scene of an environment with a row of Simulator.factors."""
    names = ("k_n", "k_d", "k_t", "mu", "k_limit", "d_limit"), ("mass", "inertia", "lift"), ("gear", "motor_bias")
    given = dict(zip(names[0], factors, strict=False))
    given |= dict.fromkeys(names[1], factors[6]) | dict.fromkeys(names[2], factors[7])
    return dataclasses.replace(scene, **{name: factor * getattr(scene, name) for name, factor in given.items()})


def step(
    scene: Scene,
    qpos: Array,
    qvel: Array,
    ctrl: Array,
    control_dt: float,
    integration: Integration,
    forces: Array | None = None,
    profile: int = 0,
) -> tuple[Array, Array]:
    """One control step of one environment."""
    h = control_dt / integration.substeps
    for _ in range(integration.substeps):
        implicit = h if integration.implicit else 0.0
        qvel = qvel + h * acceleration(scene, qpos, qvel, ctrl, implicit, forces, profile)
        qpos = integrate(scene, qpos, qvel, h)
    return qpos, qvel


def joint_dof(scene: Scene, link: int) -> int:
    return link - 1 + 6 * scene.floating


def joint_qpos(scene: Scene, link: int) -> int:
    return link - 1 + 7 * scene.floating + int((scene.ball[:link] == 2).sum())


def scalar_joints(scene: Scene) -> tuple[NDArray[np.intp], list[int]]:
    """The links on a hinge or slide, and where in qpos their joints are."""
    links = np.flatnonzero(scene.ball[1:] < 0) + 1
    return links, [joint_qpos(scene, i) for i in links]


def ball_quaternion(scene: Scene, link: int, qpos: Array) -> Array:
    """Of a ball joint's first link."""
    quaternion = qpos[joint_qpos(scene, link) :][:4]
    return quaternion / np.linalg.norm(quaternion)


def joint_position(scene: Scene, link: int, qpos: Array) -> float:
    """What the joint's spring sees: its coordinate, or a component of a ball joint's rotation vector."""
    axis = scene.ball[link]
    if axis < 0:
        return qpos[joint_qpos(scene, link)]
    w, *v = ball_quaternion(scene, link - axis, qpos)
    angle = 2 * np.arctan2(np.linalg.norm(v), abs(w))
    return angle * np.sign(w) * v[axis] / np.linalg.norm(v) if angle > 0 else 0.0


def quaternion_matrix(quaternion: Array) -> Array:
    w, v = quaternion[0], quaternion[1:]
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * skew(v)


def axis_angle_matrix(axis: Array, angle: float) -> Array:
    return np.eye(3) + np.sin(angle) * skew(axis) + (1 - np.cos(angle)) * skew(axis) @ skew(axis)


def quaternion_product(a: Array, b: Array) -> Array:
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([w, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

"""Read an MJCF file into a Scene with MuJoCo's compiler; refuse.py names what is not simulated."""

from __future__ import annotations

import copy
import dataclasses
import os
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.actuator import force_bounds, gear_of, on_joint, servo_sums, transmissions_of
from diffsim.robot.contacts import contact_points, ground_pairs, matrix_of
from diffsim.robot.elements import at_rest, control_range, disabled_flags, floating, motors, muscles, numeric, servos
from diffsim.robot.pairs import with_defaults
from diffsim.robot.refuse import beyond, obstacles, strays
from diffsim.robot.scene import Scene, Spheres
from diffsim.robot.types import Array, SceneError

Geom, Joint = mujoco.mjtGeom, mujoco.mjtJoint
DOFS = {int(Joint.mjJNT_FREE): 6, int(Joint.mjJNT_BALL): 3}  # of joints with several


def load_scene(path: str | os.PathLike[str] | mujoco.MjModel | mujoco.MjSpec) -> Scene:
    """Read an MJCF file or copy a model.

    What touches in the file touches here on MuJoCo's contact: the ground, fixed geoms, free bodies, and what moves by
    joints of its own, such as a door, a drawer or a second arm. Only the parts of one robot, a tree of bodies with its
    fixed base, pass through each other until `with_pairs`, unless the file has a free body beside another tree. To let
    bodies pass, exclude them in the file, or all by dataclasses.replace(scene, geom_pairs=()).

    Example:
        scene = diffsim.load_scene("robot.xml")
        print(scene.nq, scene.nv, scene.nu, scene.qpos0)

    Args:
        path: file, or a model or specification of MuJoCo, which stays as it is.

    Returns:
        The robot for Simulator, with MuJoCo's sizes nq, nv and nu, the pose qpos0 (nq,) at rest, the ground_height [m],
        a copy of the model as mj_model and, in left_out, what of the file is not simulated. `with_terrain(vertices)`
        and `with_penalty(constants)` return copies on other ground or with other constants of the penalty law.

    Raises:
        SceneError: the file is missing or broken, or holds elements that are not simulated (the message names all).
    """
    if isinstance(path, mujoco.MjModel | mujoco.MjSpec):
        model = path.compile() if isinstance(path, mujoco.MjSpec) else copy.copy(path)
        file = Path(model.names.partition(b"\0")[0].decode())
    elif (file := Path(path)).is_file():
        try:
            model = mujoco.MjModel.from_xml_path(str(file))
        except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
            raise SceneError(f"robot file {str(path)!r} is not a valid MJCF: {' '.join(str(error).split())}") from error
    else:
        raise SceneError(f"robot file {str(path)!r} {'is a folder' if file.is_dir() else 'does not exist'}")
    if left_out := [] if isinstance(path, mujoco.MjModel) else strays(model):
        spec = path.copy() if isinstance(path, mujoco.MjSpec) else mujoco.MjSpec.from_file(str(file))
        for body in left_out:
            gone = {spec.body(body), *spec.body(body).find_all("body")}
            gone_names = {each.name for each in gone}
            for looking in (*spec.cameras, *spec.lights):  # which only draw, and would miss what they look at
                looking.targetbody = "" if looking.targetbody in gone_names else looking.targetbody
            spec.delete(spec.body(body))  # with its joints, their actuators and numbers of keyframes
        model = spec.compile()
    _obey_flags(model)
    _refuse(file, obstacles(model))
    scene = dataclasses.replace(_Reader(model, file).scene(), left_out=tuple(left_out))
    _refuse(file, beyond(scene))
    return with_defaults(scene)


def _refuse(file: Path, found: list[str]) -> None:
    if len(found) > 1:
        found = [f"{len(found)} things keep it from being simulated:", *found]
    if found:
        raise SceneError(f"{file.name}: " + "\n  ".join(found))


def _obey_flags(m: mujoco.MjModel) -> None:
    """Remove from the compiled model what <flag ...="disable"/> switches off."""
    off = disabled_flags(m)
    if "constraint" in off:
        off |= {"contact", "equality", "frictionloss", "limit"}
    if "passive" in off:
        off |= {"spring", "damper"}
    gone = {
        "contact": (m.geom_contype, m.geom_conaffinity),
        "damper": (m.dof_damping, m.tendon_damping),
        "equality": (m.eq_active0,),
        "frictionloss": (m.dof_frictionloss, m.tendon_frictionloss),
        "gravity": (m.opt.gravity,),
        "limit": (m.jnt_limited, m.tendon_limited),
        "spring": (m.jnt_stiffness, m.tendon_stiffness),
    }
    for flag in off & gone.keys():
        for values in gone[flag]:
            values[:] = 0
    if {"spring", "damper"} <= off:
        m.opt.density = m.opt.viscosity = 0
        m.body_gravcomp[:] = 0


class Segment(NamedTuple):
    """A straight piece of a muscle's path between two links, the lower one first; ends in their frames."""

    links: tuple[int, int]
    ends: Array
    actuator: int


class _Reader:
    """Walks a compiled MjModel once, body by body. The links after the base are its degrees of freedom, in order."""

    def __init__(self, model: mujoco.MjModel, file: Path) -> None:
        self.m, self.file = model, file
        self.first = 6 if floating(model) else 0  # degrees of freedom of the base
        self.nlink = 1 + model.nv - self.first
        self.parent = np.zeros(self.nlink, np.int32)
        self.rotation, self.position = np.tile(np.eye(3), (self.nlink, 1, 1)), np.zeros((self.nlink, 3))
        # Each body's link (-1: fixed to the world of a floating scene) and its pose in the link's frame.
        self.body: list[tuple[int, Array, Array]] = [(-1 if self.first else 0, np.eye(3), np.zeros(3))]

    def scene(self) -> Scene:
        m = self.m
        for body in range(1, m.nbody):
            self._read_body(body)
        joints, inertias = self._joints(), self._inertias()
        springs = np.where(np.isfinite(joints["force_low"]), joints["servo_stiffness"], joints["stiffness"])
        return Scene(
            name=self.file.stem,
            path=str(self.file),
            mj_model=m,
            floating=floating(m),
            nq=m.nq,
            nv=m.nv,
            parent=self.parent,
            rotation=self.rotation,
            position=self.position,
            **joints,
            **inertias,
            **self._actuators(springs),
            transmissions=transmissions_of(m, self.nlink, self.body),
            **self._contacts(joints["slide"]),
            k_n=self._numeric("k_n", np.nan),
            k_d=self._numeric("k_d", np.nan),
            k_t=self._numeric("k_t", np.nan),
            mu=self._numeric("mu", np.nan),
            body_link=np.array([link for link, _, _ in self.body], np.int32),
            body_com=np.array([p + r @ com for (_, r, p), com in zip(self.body, m.body_ipos, strict=True)]),
            gravity=np.array(m.opt.gravity),
            density=float(m.opt.density),
            viscosity=float(m.opt.viscosity),
        )

    def _link(self, joint: int) -> int:
        """Return the first link of a joint."""
        return int(self.m.jnt_dofadr[joint]) - self.first + 1

    def _read_body(self, body: int) -> None:
        m = self.m
        link, parent_rotation, parent_position = self.body[m.body_parentid[body]]
        rotation = parent_rotation @ matrix_of(m.body_quat[body])
        position = parent_position + parent_rotation @ m.body_pos[body]
        joints = range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])
        free = bool(joints) and m.jnt_type[joints[0]] == Joint.mjJNT_FREE
        rotation = np.eye(3) if free else rotation
        if free and self.first:
            link, position, joints = 0, np.zeros(3), range(0)
        for joint in joints:
            anchor = np.array(m.jnt_pos[joint])
            position = position + rotation @ anchor
            for k in range(DOFS.get(int(m.jnt_type[joint]), 1)):
                parent, link = link, self._link(joint) + k
                self.parent[link], self.rotation[link], self.position[link] = parent, rotation, position
                rotation, position = np.eye(3), np.zeros(3)
            position = -anchor
        self.body.append((link, rotation, position))

    def _joints(self) -> dict[str, Any]:
        """Read the joints into columns (nlink, ...), zero for the base."""
        m, dof = self.m, np.arange(self.first, self.m.nv)
        joint = m.dof_jntid[dof]
        nth, limited, free = dof - m.jnt_dofadr[joint], m.jnt_limited[joint] != 0, m.jnt_type[joint] == Joint.mjJNT_FREE
        ball, at = (m.jnt_type[joint] == Joint.mjJNT_BALL) | (free & (nth > 2)), m.jnt_qposadr[joint] + nth * free

        def column(values: Array, base: float = 0.0) -> Array:
            return np.concatenate((np.full((1, *values.shape[1:]), base), values))

        return {
            "slide": np.concatenate(([False], (m.jnt_type[joint] == Joint.mjJNT_SLIDE) | (free & ~ball))),
            "ball": np.concatenate(([-1], np.where(ball, nth % 3, -1))).astype(np.int32),
            "axis": column(np.where((ball | free)[:, None], np.eye(3)[nth % 3], m.jnt_axis[joint])),
            "joint_ref": column(np.where(ball, 0.0, m.qpos0[at])),
            "armature": column(m.dof_armature[dof]),
            **{name: column(values, base) for name, (values, base) in self._springs(joint, ball).items()},
            "lower": column(np.where(limited, m.jnt_range[joint, 0], -np.inf), -np.inf),
            "upper": column(np.where(limited, m.jnt_range[joint, 1], np.inf), np.inf),
            "k_limit": column(np.where(limited, self._numeric("k_limit", np.nan), 0.0)),
            "d_limit": column(np.where(limited, self._numeric("d_limit", np.nan), 0.0)),
        }

    def _springs(self, joint: NDArray[np.int32], ball: NDArray[np.bool_]) -> dict[str, tuple[Array, float]]:
        """Read springs, dampers and servos of each degree of freedom after the base, and the base's value of each."""
        m = self.m
        servo, (low, high) = servo_sums(m, self.nlink), force_bounds(m, self.nlink)
        bounded = np.isfinite(low) | np.isfinite(high)
        free, within = servo.where(~bounded), servo.where(bounded)  # the free ones join the joint's own
        ref = np.where(ball, 0.0, m.qpos_spring[m.jnt_qposadr[joint]])  # a ball's is the identity in every MJCF
        total, joined = m.jnt_stiffness[joint] + free.stiffness, (free.stiffness > 0) | (free.push != 0)
        moved = np.divide(m.jnt_stiffness[joint] * ref + free.push, total, out=ref.copy(), where=total > 0)
        own = np.divide(within.push, within.stiffness, out=np.zeros_like(ref), where=within.stiffness > 0)
        return {
            "damping": (m.dof_damping[self.first :] + free.damping, 0.0),
            "stiffness": (total, 0.0),
            "spring_ref": (np.where(joined, moved, ref), 0.0),
            "servo_stiffness": (within.stiffness, 0.0),
            "servo_damping": (within.damping, 0.0),
            "servo_ref": (own, 0.0),
            "force_low": (low, -np.inf),
            "force_high": (high, np.inf),
        }

    def _inertias(self) -> dict[str, Any]:
        """Sum mass, com, inertia and gravity compensation (nlink, ...) over bodies that are welded together."""
        m = self.m
        mass, moment, inertia = np.zeros(self.nlink), np.zeros((self.nlink, 3)), np.zeros((self.nlink, 3, 3))
        lift, lifted, base_damping = np.zeros(self.nlink), np.zeros((self.nlink, 3)), np.zeros(self.nlink)
        if self.first:  # a free joint's armature is a point mass with moments of inertia that gravity does not pull on
            mass[0], inertia[0], lift[0] = m.dof_armature[0], m.dof_armature[0] * np.eye(3), m.dof_armature[0]
            base_damping[0] = m.dof_damping[0]
        for body, (link, rotation, position) in enumerate(self.body):
            if body == 0 or link < 0:
                continue
            principal = rotation @ matrix_of(m.body_iquat[body])
            com = position + rotation @ m.body_ipos[body]
            mass[link] += m.body_mass[body]
            moment[link] += m.body_mass[body] * com
            lift[link] += m.body_gravcomp[body] * m.body_mass[body]
            lifted[link] += m.body_gravcomp[body] * m.body_mass[body] * com
            about_com = principal @ np.diag(m.body_inertia[body]) @ principal.T
            inertia[link] = inertia[link] + about_com - m.body_mass[body] * _skew(com) @ _skew(com)
        com = moment / np.where(mass > 0, mass, 1.0)[:, None]
        about_com = inertia + mass[:, None, None] * np.array([_skew(c) @ _skew(c) for c in com])
        lift_position = lifted / np.where(lift != 0, lift, 1.0)[:, None]
        of_gravity = {"lift": lift, "lift_position": lift_position, "base_damping": base_damping}
        return {"mass": mass, "com": com, "inertia": about_com} | of_gravity

    def _actuators(self, springs: Array) -> dict[str, Any]:
        """Read actuators into columns (nu, ...); a servo's constant force is a motor's if its link has no spring."""
        m = self.m
        link, gear, (low, high) = np.zeros(m.nu, np.int32), np.ones(m.nu), control_range(m)
        scale, segments = m.actuator_gainprm[:, 0].copy(), list[Segment]()
        for a in np.flatnonzero(muscles(m)).tolist():
            segments += self._path(m.actuator_trnid[a, 0], a)
            scale[a] = self._strength(a)
        for a in np.flatnonzero(on_joint(m)).tolist():
            link[a], gear[a] = gear_of(m, a, self.nlink)
            scale[a] *= gear[a]
        constant_force = np.where(servos(m) & (springs[link] == 0), gear * m.actuator_biasprm[:, 0], 0)
        segments.sort(key=lambda segment: (segment.links, segment.actuator))
        return {
            "motor_link": link,
            "gear": scale * (high - low) / 2,
            "motor_bias": scale * (high + low) / 2 + constant_force,
            "segment_link": np.array([s.links for s in segments], np.int32).reshape(-1, 2),
            "segment_position": np.array([s.ends for s in segments]).reshape(-1, 2, 3),
            "segment_muscle": np.array([s.actuator for s in segments], np.int32),
        }

    def _strength(self, a: int) -> float:
        """Return the force of a tendon's actuator per activation."""
        m, strength, gain = self.m, self._numeric("muscle_strength", 1.0), self.m.actuator_gainprm[a]
        if motors(m)[a]:
            return -strength * m.actuator_gear[a, 0] * gain[0]
        force, per_weight = gain[2:4]
        return strength * (force if force >= 0 else per_weight / m.actuator_acc0[a])

    def _path(self, tendon: int, actuator: int) -> list[Segment]:
        """Return a tendon's segments between two links."""
        m, points = self.m, list[tuple[int, Array]]()
        for site in m.wrap_objid[m.tendon_adr[tendon] :][: m.tendon_num[tendon]]:
            link, rotation, position = self.body[m.site_bodyid[site]]
            points.append((link, position + rotation @ m.site_pos[site]))
        segments = list[Segment]()
        for (i, a), (j, b) in zip(points, points[1:], strict=False):
            if i != j:
                ends = [a, b] if i < j else [b, a]
                segments.append(Segment((min(i, j), max(i, j)), np.array(ends), actuator))
        return segments

    def _contacts(self, slide: NDArray[np.bool_]) -> dict[str, Any]:
        m, pairs = self.m, ground_pairs(self.m)
        spheres = self._spheres([geom for _, geom in pairs])
        outer = self._outer(spheres, slide)
        return {
            "spheres": spheres,
            "contact_link": spheres.link[outer],
            "contact_position": spheres.centre[outer],
            "contact_radius": spheres.radius[outer],
            "ground_height": float(at_rest(m).geom_xpos[pairs[0][0], 2]) if pairs else 0.0,
        }

    def _spheres(self, geoms: list[int]) -> Spheres:
        m, centres, directions, radii = self.m, [np.zeros((0, 3))], [np.zeros((0, 3))], []
        for geom in geoms:
            _, rotation, position = self.body[m.geom_bodyid[geom]]
            axes, centre = rotation @ matrix_of(m.geom_quat[geom]), position + rotation @ m.geom_pos[geom]
            points, radius = contact_points(m, geom)
            centres.append(np.array([centre + axes @ point for point in points]))
            along = {Geom.mjGEOM_CAPSULE: np.tile(axes[:, 2], (2, 1)), Geom.mjGEOM_BOX: points @ axes.T}
            directions.append(along.get(Geom(m.geom_type[geom]), np.zeros_like(points)))
            radii.append(radius)
        counts = [len(points) for points in centres[1:]]
        links = np.array([self.body[m.geom_bodyid[geom]][0] for geom in geoms], np.int32)
        geom_of = np.repeat(np.array(geoms, np.int32), counts)
        each = np.repeat(links, counts), np.concatenate(centres), np.repeat(radii, counts)
        return Spheres(*each, geom_of, np.concatenate(directions))

    def _outer(self, spheres: Spheres, slide: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Select, by link, spheres that are not inside another one in every pose: overlapping capsules count once."""
        order = np.argsort(-spheres.radius, kind="stable")
        # Where each is in the frame of the first link that sees it at rest: a centre on a hinge's anchor stays there.
        at, centres, radii = spheres.link[order], spheres.centre[order], spheres.radius[order]
        for k in range(len(order)):
            while at[k] > 0 and not slide[at[k]] and np.linalg.norm(centres[k]) < 1e-6:
                centres[k], at[k] = self.position[at[k]], self.parent[at[k]]
        kept = np.zeros(len(order), bool)
        for k in range(len(order)):
            others = np.flatnonzero(kept[:k] & (at[:k] == at[k]))
            apart = np.linalg.norm(centres[others] - centres[k], axis=1)
            kept[k] = not (apart + radii[k] <= radii[others] + 1e-6).any()
        return order[kept][np.argsort(spheres.link[order[kept]], kind="stable")]

    def _numeric(self, name: str, default: float) -> float:
        values = numeric(self.m, name)
        return float(values[0]) if len(values) else default


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

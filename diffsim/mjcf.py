"""MJCF -> Scene, by way of MuJoCo's compiler; what is not simulated is refused by name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from diffsim.scene import PENALTY_DEFAULTS, Array, Scene, SceneError


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read an MJCF file.

    Raises:
        SceneError: the file is missing or broken, or holds an element that is not simulated (named in the message).
    """
    file = Path(path)
    if not file.is_file():
        raise SceneError(f"robot file {str(path)!r} does not exist")
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise SceneError(f"robot file {str(path)!r} is not a valid MJCF: {' '.join(str(error).split())}") from error
    return _Reader(model, file).scene()


class Sphere(NamedTuple):
    """What may touch the ground, in the frame of its link."""

    link: int
    centre: Array
    radius: float


class _Reader:
    """Walks a compiled MjModel once, body by body."""

    def __init__(self, model: mujoco.MjModel, file: Path) -> None:
        self.m = model
        self.file = file
        self.links: list[dict[str, Any]] = []
        self.joint_link: dict[int, int] = {}
        # Of each body: its link (-1: fixed to the world of a floating scene) and its pose in the link's frame.
        self.body: list[tuple[int, Array, Array]] = [(-1, np.eye(3), np.zeros(3))]

    def scene(self) -> Scene:
        m = self.m
        self._check_supported()
        floating = bool(m.njnt and (m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())
        if not floating:
            self._add_link(parent=0)
            self.body[0] = (0, np.eye(3), np.zeros(3))
        for body in range(1, m.nbody):
            self._read_body(body)
        if not self.links or (len(self.links) == 1 and not floating):
            raise self._error("no joint: there is nothing to simulate")
        columns: dict[str, Any] = {key: np.array([link[key] for link in self.links]) for key in self.links[0]}
        mass = columns.pop("mass")
        com = columns.pop("moment") / np.where(mass > 0, mass, 1.0)[:, None]
        about_origin = columns.pop("inertia")
        inertia = about_origin + mass[:, None, None] * np.array([_skew(c) @ _skew(c) for c in com])
        columns |= {key: columns[key].astype(np.int32) for key in ("parent", "ball")}
        return Scene(
            name=self.file.stem,
            path=str(self.file),
            mj_model=m,
            floating=floating,
            nq=m.nq,
            nv=m.nv,
            mass=mass,
            com=com,
            inertia=inertia,
            gravity=np.array(m.opt.gravity),
            density=float(m.opt.density),
            viscosity=float(m.opt.viscosity),
            **columns,
            **self._actuators(),
            **self._contacts(),
            **self._penalties(),
        )

    def _error(self, text: str) -> SceneError:
        return SceneError(f"{self.file.name}: {text}")

    def _refused(self, kind: mujoco.mjtObj, index: int, why: str) -> SceneError:
        label = str(kind).rsplit("mjOBJ_", 1)[-1].lower()
        return self._error(f"{label} {mujoco.mj_id2name(self.m, kind, index) or f'number {index}'!r}: {why}")

    def _any(self, field: str, index: int) -> bool:
        """Whether a field that only newer versions of MuJoCo have is set."""
        return bool(np.any(getattr(self.m, field)[index])) if hasattr(self.m, field) else False

    def _check_supported(self) -> None:
        m, kind = self.m, mujoco.mjtObj
        for what, count in ((kind.mjOBJ_EQUALITY, m.neq), (kind.mjOBJ_PAIR, m.npair)):
            if count:
                raise self._refused(what, 0, "not simulated")
        for tendon in range(m.ntendon):
            self._check_tendon(tendon)
        for body in range(m.nbody):
            if m.body_gravcomp[body] or m.body_mocapid[body] >= 0:
                raise self._refused(kind.mjOBJ_BODY, body, "gravcomp and mocap are not simulated")
        for joint in range(m.njnt):
            self._check_joint(joint)
        if np.any(m.opt.wind):
            raise self._error("option wind: only a fluid at rest is simulated")
        if m.opt.density or m.opt.viscosity:
            self._check_fluid()

    def _check_tendon(self, tendon: int) -> None:
        m, kind = self.m, mujoco.mjtObj.mjOBJ_TENDON
        path = m.wrap_type[m.tendon_adr[tendon] :][: m.tendon_num[tendon]]
        if (path != mujoco.mjtWrap.mjWRAP_SITE).any():
            raise self._refused(kind, tendon, "only spatial tendons through sites, without pulleys or wrapping geoms")
        for field in ("stiffness", "damping", "limited", "frictionloss", "armature", "actfrclimited"):
            if self._any(f"tendon_{field}", tendon):
                raise self._refused(kind, tendon, f"{field} of a tendon is not simulated")

    def _check_joint(self, joint: int) -> None:
        m, dof = self.m, self.m.jnt_dofadr[joint]
        free, ball = (m.jnt_type[joint] == kind for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))
        polynomial = self._any("dof_dampingpoly", dof) or self._any("jnt_stiffnesspoly", joint)
        passive = m.dof_armature[dof] or m.dof_damping[dof] or m.jnt_stiffness[joint]
        for wrong, why in (
            (m.jnt_actfrclimited[joint], "actuatorfrcrange is not simulated"),
            (polynomial, "damping and stiffness are linear here, one number each"),
            (ball and m.jnt_limited[joint], "the limit of a ball joint is not simulated"),
            (m.dof_frictionloss[dof], "frictionloss is not simulated"),
            (free and passive, "a free joint has no armature, damping or stiffness here"),
            (
                free and (joint or m.body_parentid[m.jnt_bodyid[joint]]),
                "one free joint, of the first moving body, is simulated",
            ),
        ):
            if wrong:
                raise self._refused(mujoco.mjtObj.mjOBJ_JOINT, joint, why)

    def _check_fluid(self) -> None:
        m, kind = self.m, mujoco.mjtObj
        for body in range(1, m.nbody):
            if m.body_mass[body] > 0 and not m.body_jntnum[body] and m.body_weldid[body]:
                raise self._refused(kind.mjOBJ_BODY, body, "in a fluid each body needs a joint; merge its geoms")
        for geom in range(m.ngeom):
            if m.geom_fluid[geom, 0]:
                raise self._refused(kind.mjOBJ_GEOM, geom, "fluidshape ellipsoid is not simulated")

    def _add_link(self, parent: int, joint: int = -1, ball: int = -1, **values: Any) -> int:
        m = self.m
        dof, adr = (m.jnt_dofadr[joint], m.jnt_qposadr[joint]) if joint >= 0 else (-1, -1)
        moving = joint >= 0 and m.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE
        limited, scalar = moving and m.jnt_limited[joint], moving and ball < 0
        axis = np.array(m.jnt_axis[joint]) if scalar else np.zeros(3)
        link = {
            "parent": parent,
            "slide": moving and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE,
            "ball": ball,
            "rotation": np.eye(3),
            "position": np.zeros(3),
            "axis": np.eye(3)[ball] if ball >= 0 else axis,
            "joint_ref": m.qpos0[adr] if scalar else 0.0,
            "armature": m.dof_armature[dof] if moving else 0.0,
            "damping": m.dof_damping[dof] if moving else 0.0,
            "stiffness": m.jnt_stiffness[joint] if moving else 0.0,
            "spring_ref": m.qpos_spring[adr] if scalar else 0.0,  # a ball's is the identity in every MJCF
            "lower": m.jnt_range[joint, 0] if limited else -np.inf,
            "upper": m.jnt_range[joint, 1] if limited else np.inf,
            "mass": 0.0,
            "moment": np.zeros(3),
            "inertia": np.zeros((3, 3)),
        }
        self.links.append(link | values)
        self.joint_link[joint] = len(self.links) - 1
        return len(self.links) - 1

    def _read_body(self, body: int) -> None:
        m = self.m
        link, parent_rotation, parent_position = self.body[m.body_parentid[body]]
        rotation = parent_rotation @ _matrix(m.body_quat[body])
        position = parent_position + parent_rotation @ m.body_pos[body]
        joints = range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])
        if joints and m.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_FREE:
            link = self._add_link(parent=0, joint=joints[0])
            rotation, position = np.eye(3), np.zeros(3)
        else:
            if joints and link < 0:
                raise self._refused(mujoco.mjtObj.mjOBJ_BODY, body, "a second base beside a floating one")
            for joint in joints:
                anchor = np.array(m.jnt_pos[joint])
                position = position + rotation @ anchor
                for ball in range(3) if m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL else (-1,):
                    link = self._add_link(link, joint, ball, rotation=rotation, position=position)
                    rotation, position = np.eye(3), np.zeros(3)
                position = -anchor
        self.body.append((link, rotation, position))
        if link >= 0:
            self._add_inertia(self.links[link], body, rotation, position)

    def _add_inertia(self, link: dict[str, Any], body: int, rotation: Array, position: Array) -> None:
        m = self.m
        mass = m.body_mass[body]
        principal = rotation @ _matrix(m.body_iquat[body])
        com = position + rotation @ m.body_ipos[body]
        link["mass"] += mass
        link["moment"] = link["moment"] + mass * com
        about_com = principal @ np.diag(m.body_inertia[body]) @ principal.T
        link["inertia"] = link["inertia"] + about_com - mass * _skew(com) @ _skew(com)

    def _actuators(self) -> dict[str, Any]:
        m = self.m
        rows = [
            self._muscle(a) if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON else self._motor(a)
            for a in range(m.nu)
        ]
        segments = sorted((s for row in rows for s in row["segments"]), key=lambda s: (s[0], s[2]))
        text = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_TEXT, "muscle_model")
        model = m.text_data[m.text_adr[text] :].partition(b"\0")[0].decode() if text >= 0 else "linear"
        return {
            "motor_link": np.array([row["link"] for row in rows], np.int32),
            "gear": np.array([row["scale"] * (row["high"] - row["low"]) / 2 for row in rows]),
            "motor_bias": np.array([row["scale"] * (row["high"] + row["low"]) / 2 for row in rows]),
            "segment_link": np.array([links for links, _, _ in segments], np.int32).reshape(-1, 2),
            "segment_position": np.array([ends for _, ends, _ in segments]).reshape(-1, 2, 3),
            "segment_muscle": np.array([muscle for _, _, muscle in segments], np.int32),
            "hill": np.array([row["hill"] for row in rows]).reshape(-1, 9),
            "muscle_model": model,
        }

    def _check_actuator(self, a: int, fits: bool, allowed: str) -> None:
        m = self.m
        extras = m.actuator_forcelimited[a] or self._any("actuator_damping", a) or self._any("actuator_armature", a)
        if extras or not fits:
            raise self._refused(mujoco.mjtObj.mjOBJ_ACTUATOR, a, f"only {allowed}")

    def _is_motor(self, a: int) -> bool:
        m = self.m
        return (
            m.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE
            and m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
            and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        )

    def _motor(self, a: int) -> dict[str, Any]:
        m = self.m
        joint, axis = m.actuator_trnid[a, 0], 0
        fits = m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and self._is_motor(a)
        kind = m.jnt_type[joint] if fits else mujoco.mjtJoint.mjJNT_FREE
        if kind == mujoco.mjtJoint.mjJNT_BALL:  # a torque about one axis of the turned body's frame
            axis = int(np.abs(m.actuator_gear[a, :3]).argmax())
            fits = not np.delete(m.actuator_gear[a, :3], axis).any()
        self._check_actuator(
            a,
            fits and kind != mujoco.mjtJoint.mjJNT_FREE,
            "motors with a gear and a ctrlrange on a hinge, a slide or one axis of a ball joint, or muscles on tendons",
        )
        low, high = m.actuator_ctrlrange[a] if m.actuator_ctrllimited[a] else (-1.0, 1.0)
        link = self.joint_link[joint] + (axis - 2 if kind == mujoco.mjtJoint.mjJNT_BALL else 0)
        scale = m.actuator_gear[a, axis] * m.actuator_gainprm[a, 0]
        return {"link": link, "scale": scale, "low": low, "high": high, "segments": [], "hill": [np.nan] * 9}

    def _muscle(self, a: int) -> dict[str, Any]:
        m = self.m
        strength = self._numeric("muscle_strength", 1.0)
        low, high = m.actuator_ctrlrange[a] if m.actuator_ctrllimited[a] else (0.0, 1.0)
        gain, motor = m.actuator_gainprm[a, :9], self._is_motor(a)
        scale = -strength * m.actuator_gear[a, 0] * gain[0]
        muscle = (
            m.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_MUSCLE
            and m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE
            and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_MUSCLE
            and np.array_equal(gain, m.actuator_biasprm[a, :9])
        )
        self._check_actuator(
            a,
            (motor and min(scale * low, scale * high) >= 0)
            or (muscle and m.actuator_gear[a, 0] == 1 and 0 <= low < high <= 1),
            "<muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push, on a tendon",
        )
        constant, segments = self._path(m.actuator_trnid[a, 0], a)
        hill = [np.nan] * 9
        if muscle:
            start, end, force, per_weight, lmin, lmax, vmax, fpmax, fvmax = gain
            scale = strength * (force if force >= 0 else per_weight / m.actuator_acc0[a])
            near, far = m.actuator_lengthrange[a]
            fibre = (far - near) / (end - start)  # m, where the muscle is strongest
            hill = [constant, 1 / fibre, start - near / fibre, 1 / (fibre * vmax), lmin, lmax, fpmax, fvmax, scale]
        return {"link": 0, "scale": scale, "low": low, "high": high, "segments": segments, "hill": hill}

    def _path(self, tendon: int, actuator: int) -> tuple[float, list[tuple[tuple[int, int], Array, int]]]:
        """Of a tendon the length within links, and the segments between two: (links, end points, actuator)."""
        m = self.m
        points: list[tuple[int, Array]] = []
        for site in m.wrap_objid[m.tendon_adr[tendon] :][: m.tendon_num[tendon]]:
            link, rotation, position = self.body[m.site_bodyid[site]]
            if link < 0:
                why = "a muscle of a floating robot cannot hold on to the world"
                raise self._refused(mujoco.mjtObj.mjOBJ_SITE, site, why)
            points.append((link, position + rotation @ m.site_pos[site]))
        constant, segments = 0.0, []
        for (i, a), (j, b) in zip(points, points[1:], strict=False):
            if i == j:
                constant += float(np.linalg.norm(b - a))
            else:
                segments.append(((i, j) if i < j else (j, i), np.array([a, b] if i < j else [b, a]), actuator))
        return constant, segments

    def _contacts(self) -> dict[str, Any]:
        m = self.m
        data = mujoco.MjData(m)
        mujoco.mj_kinematics(m, data)
        static = [g for g in range(m.ngeom) if m.body_weldid[m.geom_bodyid[g]] == 0]
        moving = [g for g in range(m.ngeom) if m.body_weldid[m.geom_bodyid[g]] != 0]
        touched = [s for s in static if any(self._collide(s, g) for g in moving)]
        spheres: list[Sphere] = []
        height = 0.0
        for plane in touched:
            if m.geom_type[plane] != mujoco.mjtGeom.mjGEOM_PLANE or len(touched) > 1:
                raise self._refused(mujoco.mjtObj.mjOBJ_GEOM, plane, "contact is simulated with one ground plane only")
            if not np.allclose(data.geom_xmat[plane].reshape(3, 3)[:, 2], [0.0, 0.0, 1.0]):
                raise self._refused(mujoco.mjtObj.mjOBJ_GEOM, plane, "the ground plane must be horizontal")
            height = float(data.geom_xpos[plane, 2])
            for g in moving:
                if self._collide(plane, g):
                    spheres += self._spheres(g)
        spheres = self._outer_spheres(spheres)
        return {
            "contact_link": np.array([sphere.link for sphere in spheres], np.int32),
            "contact_position": np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
            "contact_radius": np.array([sphere.radius for sphere in spheres]),
            "ground_height": height,
        }

    def _collide(self, a: int, b: int) -> bool:
        m = self.m
        masks = m.geom_contype[a] & m.geom_conaffinity[b] or m.geom_contype[b] & m.geom_conaffinity[a]
        low, high = sorted((m.geom_bodyid[a], m.geom_bodyid[b]))
        return bool(masks) and (int(low) << 16) + int(high) not in m.exclude_signature

    def _spheres(self, geom: int) -> list[Sphere]:
        m, kind = self.m, mujoco.mjtGeom
        link, rotation, position = self.body[m.geom_bodyid[geom]]
        axes = rotation @ _matrix(m.geom_quat[geom])
        centre = position + rotation @ m.geom_pos[geom]
        size = m.geom_size[geom]
        if m.geom_type[geom] == kind.mjGEOM_SPHERE:
            return [Sphere(link, centre, size[0])]
        if m.geom_type[geom] == kind.mjGEOM_CAPSULE:
            return [Sphere(link, centre + s * size[1] * axes[:, 2], size[0]) for s in (-1.0, 1.0)]
        if m.geom_type[geom] == kind.mjGEOM_BOX:
            signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
            return [Sphere(link, centre + axes @ (s * size), 0.0) for s in signs]
        why = "only spheres, capsules and boxes may touch the ground; set contype and conaffinity to 0 if only drawn"
        raise self._refused(mujoco.mjtObj.mjOBJ_GEOM, geom, why)

    def _outer_spheres(self, spheres: list[Sphere]) -> list[Sphere]:
        """Drop spheres that lie inside another one in every pose, so that overlapping capsules count once, by link."""

        def seen_from_parent(sphere: Sphere) -> Sphere:
            # A centre on the hinge's anchor does not move in the parent's frame.
            link, centre = sphere.link, sphere.centre
            while link > 0 and not self.links[link]["slide"] and np.linalg.norm(centre) < 1e-6:
                centre, link = self.links[link]["position"], self.links[link]["parent"]
            return Sphere(link, centre, sphere.radius)

        kept: list[Sphere] = []
        for sphere in sorted(spheres, key=lambda sphere: -sphere.radius):
            link, place, radius = seen_from_parent(sphere)
            others = [other for other in map(seen_from_parent, kept) if other.link == link]
            if not any(np.linalg.norm(o.centre - place) + radius <= o.radius + 1e-6 for o in others):
                kept.append(sphere)
        return sorted(kept, key=lambda sphere: sphere.link)

    def _penalties(self) -> dict[str, Any]:
        return {name: self._numeric(name, default) for name, default in PENALTY_DEFAULTS.items()}

    def _numeric(self, name: str, default: float) -> float:
        index = mujoco.mj_name2id(self.m, mujoco.mjtObj.mjOBJ_NUMERIC, name)
        value = float(self.m.numeric_data[self.m.numeric_adr[index]]) if index >= 0 else default
        if not (np.isfinite(value) and value >= 0):
            raise self._error(f"numeric {name!r} is {value}, must be finite and not negative")
        return value


def _matrix(quaternion: Array) -> Array:
    result = np.zeros(9)
    mujoco.mju_quat2Mat(result, np.asarray(quaternion, float))
    return result.reshape(3, 3)


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

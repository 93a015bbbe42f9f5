"""Scene: the arrays that the kernels read, and the features that it uses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.elements import takes_euler
from diffsim.robot.profile import TerrainError, check_terrain
from diffsim.robot.types import Array, Constraints, Index, Pairs, Transmissions

# Constants of soft contact (Eq. 3) and limits (Eq. 4), with their units. In the MJCF
# <custom><numeric name="k_n" data="2e4"/></custom> sets one.
PENALTY_CONSTANTS = {
    "k_n": "N/m",
    "k_d": "N s/m^2",
    "k_t": "N s/m",
    "mu": "",
    "k_limit": "N/m or N m/rad",
    "d_limit": "N s/m^2 or N m s/rad^2",
}
# What may differ between environments, see Simulator: each column of its factors multiplies one of these.
FACTORS = (*PENALTY_CONSTANTS, "mass", "motor")


class RootCoordinates(NamedTuple):
    """The root's position as a function of qpos: the carrier's, see Scene.carrier."""

    position: Array  # (3,) m, at qpos = 0
    along: Array  # (nq,) the root's x is position[0] + along . qpos
    up: Array  # (nq,) qpos + up is one metre higher; zero if no coordinate moves the root vertically


class Spheres(NamedTuple):
    """Spheres that may touch the ground, in the frames of their links."""

    link: Index  # (n,)
    centre: Array  # (n, 3)
    radius: Array  # (n,)
    geom: Index  # (n,) the geom that each stands for
    axis: Array  # (n, 3) a capsule's unit vector along it, of a box's corner its place from the centre [m], else 0


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """One robot over the ground, perhaps with other free bodies, in MuJoCo's conventions: SI units, z up.

    Link 0 is the base: the floating body, or the world if the base is fixed or not alone. Each further link has one
    degree of freedom, in MuJoCo's order; bodies with several joints become several links, welded bodies are merged. A
    link's frame sits at its joint's anchor: R = R_parent rotation Rot(axis, q - q_ref). A ball joint makes three links
    in a row, all in the frame of the body that it turns and about one axis each. Only the last has mass.

    Arrays have nlink rows unless said.
    """

    name: str
    path: str
    mj_model: mujoco.MjModel
    floating: bool
    nq: int
    nv: int
    parent: Index  # the parent link; the base's own is 0
    slide: NDArray[np.bool_]  # whether the joint is a slide
    ball: Index  # 0, 1, 2 for the three links of a ball joint, -1 elsewhere
    rotation: Array  # (3, 3) and
    position: Array  # (3,) m, the frame in the parent's frame at the reference configuration
    axis: Array  # (3,) unit joint axis in the link's frame
    joint_ref: Array  # q at the reference configuration (MJCF `ref`)
    mass: Array  # kg
    com: Array  # (3,) m, in the link's frame
    inertia: Array  # (3, 3) kg m^2 about the centre of mass, link axes
    lift: Array  # kg, of which gravity is compensated, and
    lift_position: Array  # (3,) m, where that acts, in the link's frame
    base_damping: Array  # of a floating base's velocity [N s/m] and angular velocity [N m s], 0 of other links
    armature: Array
    damping: Array
    stiffness: Array
    spring_ref: Array
    # Spring and damper of what drives the joint, if their sum with the motors' force is kept within bounds (infinite
    # elsewhere); without bounds they are part of stiffness and damping
    servo_stiffness: Array
    servo_damping: Array
    servo_ref: Array
    force_low: Array
    force_high: Array
    lower: Array  # bounds of the joint, infinite where unlimited
    upper: Array
    k_limit: Array  # stiffness and
    d_limit: Array  # damping of the joint's limits (Eq. 4); NaN where the file does not name them
    motor_link: Index  # (nu,) whose joint has a force of gear * ctrl + motor_bias for ctrl in [-1, 1] over ctrlrange;
    gear: Array  # (nu,)
    motor_bias: Array  # (nu,) of a muscle the link is 0, and that is the maximum force times the activation
    # Pieces of the muscles' paths that join two links, sorted by links
    segment_link: Index  # (ns, 2)
    segment_position: Array  # (ns, 2, 3) the end points in the links' frames
    segment_muscle: Index  # (ns,) whose path it is
    spheres: Spheres
    # Those that have a spring and a damper, as they do not lie inside another one in every pose
    contact_link: Index  # (nc,)
    contact_position: Array  # (nc, 3)
    contact_radius: Array  # (nc,)
    body_link: Index  # (nbody,) the link that each body of the MJCF is part of, -1 in the world of a floating scene
    body_com: Array  # (nbody, 3) its centre of mass in that link's frame
    gravity: Array
    ground_height: float
    k_n: float  # stiffness, damping and friction of contact (Eq. 3); NaN where the file does not name them
    k_d: float
    k_t: float
    mu: float
    density: float = 0.0  # kg/m^3, of the fluid around the robot
    viscosity: float = 0.0  # kg/(m s)
    terrain: Array | None = None  # (1 or num_envs, K, 2) vertices of the ground in the plane's place, see with_terrain
    left_out: tuple[str, ...] = ()  # bodies of the file beside the robot, which move by themselves and touch nothing
    geom_pairs: tuple[tuple[int, int], ...] = ()  # of geoms that may touch each other, see load_scene
    constraints: Constraints | None = None  # MuJoCo's, in place of springs and dampers, see robot/constants.py
    transmissions: Transmissions | None = None  # actuators on fixed tendons and at sites, whose motor_link is 0
    parameters: int = 0  # number of constants whose gradients the backward kernel computes, see diffsim/parameters.py

    @property
    def nlink(self) -> int:
        return len(self.parent)

    @property
    def nu(self) -> int:
        return len(self.gear)

    @property
    def ncontact(self) -> int:
        return len(self.contact_radius)

    @property
    def nbody(self) -> int:
        return len(self.body_link)

    @property
    def nball(self) -> int:
        return int((self.ball == 0).sum())

    @property
    def pairs(self) -> Pairs | None:
        """Return the rows between two bodies, which MuJoCo's constraints may have."""
        return self.constraints.pairs if self.constraints else None

    @property
    def has_trees(self) -> bool:
        """Tell whether each tree has an origin of its own: beside free bodies, or what it touches or is tied to."""
        free = mujoco.mjtJoint.mjJNT_FREE in self.mj_model.jnt_type
        return not self.floating and self.carrier == 0 and (free or self.pairs is not None)

    @property
    def qpos_adr(self) -> Index:
        """Return the index in qpos (nlink,) of each link's joint, w, x and y of its quaternion for a ball joint."""
        passed = np.concatenate([[0], np.cumsum(self.ball == 2)[:-1]])  # balls, each one number longer than its rates
        return (np.arange(self.nlink) - 1 + (7 if self.floating else 0) + passed).astype(np.int32)

    @property
    def quaternion_adr(self) -> Index:
        """Return the index in qpos of each quaternion's first number."""
        balls = self.qpos_adr[self.ball == 0]
        return np.concatenate([[3], balls]).astype(np.int32) if self.floating else balls

    @property
    def qpos0(self) -> Array:
        """Return the reference configuration (nq,) of the MJCF."""
        return np.array(self.mj_model.qpos0)

    @property
    def features(self) -> frozenset[str]:
        """Return the features that the scene uses; the generated kernels contain no others."""
        limited, law = np.isfinite(self.lower) | np.isfinite(self.upper), self.constraints
        opt, disabled = self.mj_model.opt, mujoco.mjtDisableBit
        pyramidal = opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        euler, off = law is not None and takes_euler(self.mj_model), opt.disableflags & int(disabled.mjDSBL_EULERDAMP)
        damped, servos = bool(self.damping.any() or self.base_damping.any()), bool(self.servo_damping.any())
        present = {
            "floating": self.floating,
            "trees": self.has_trees,
            "gyroscopic": len(self.free_bodies) > 0,
            "hinge": bool((~self.slide & (self.ball < 0))[1:].any()),
            "slide": bool(self.slide[1:].any()),
            "ball": self.nball > 0,
            "contact": self.ncontact > 0,
            "terrain": self.ncontact > 0 and self.terrain is not None,
            "pyramid": law is not None and pyramidal and law.rough,
            "box": law is not None and bool(law.axis[self.contact_radius == 0].any()),
            "limit": bool((limited & ((self.k_limit != 0) | (self.d_limit != 0) | (law is not None))).any()),
            "frictionloss": law is not None and bool(law.loss[:, 0].any()),
            "gravcomp": bool(self.lift.any() and self.gravity.any()),
            "base_damping": bool(self.base_damping.any()),
            "stiffness": bool(self.stiffness.any()),
            "damping": bool(self.damping.any()) or servos,
            "explicit_servos": euler and servos,
            "explicit_damping": euler and (damped or servos) and bool(off or not damped),
            "clamp": bool((np.isfinite(self.force_low) | np.isfinite(self.force_high)).any()) or servos,
            "motor": bool((self.motor_link > 0).any()),
            "muscle": len(self.segment_muscle) > 0,
            "drag": self.density > 0 or self.viscosity > 0,
        }
        rows = self.pairs.features if self.pairs else frozenset[str]()
        rows |= self.transmissions.features(law is not None, explicit=euler) if self.transmissions else rows
        return frozenset(name for name, used in present.items() if used) | rows

    @property
    def carrier(self) -> int:
        """Return the link that carries the origin of spatial vectors, so that no digits are lost far from the world's.

        It is the floating base, or the last of the massless slides between a planar robot and the world, whose motion
        only translates everything else, or otherwise the fixed base.
        """
        link = 0
        while not self.floating and link + 1 < self.nlink and self.slide[link + 1]:
            children = np.flatnonzero(self.parent[1:] == link) + 1
            busy = [*self.contact_link, *self.segment_link.flat, *(self.pairs.link.flat if self.pairs else [])]
            busy += [*self.transmissions.site_link] if self.transmissions else []
            if len(children) != 1 or self.mass[link] > 0 or link in busy:
                break
            link += 1
        return link

    @property
    def free_bodies(self) -> Index:
        """Return the links of free bodies without joints, whose spin MuJoCo's implicitfast integrates implicitly.

        That changes nothing of a ball, whose inertia is the same about all axes, unless that is a parameter.
        """
        m, links = self.mj_model, list[int]()
        if self.constraints is None or takes_euler(m):
            return np.zeros(0, np.int32)
        sizes = np.bincount(m.dof_treeid, minlength=m.ntree)
        for dof in m.jnt_dofadr[m.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist():
            link = 0 if self.floating else dof + 6
            round_ = np.ptp(np.linalg.eigvalsh(self.inertia[link])) < 1e-9 * self.inertia[link].max()
            round_ &= abs(self.com[link]).max() < 1e-9
            if sizes[m.dof_treeid[dof]] == 6 and (self.parameters or not round_):
                links.append(link)
        return np.array(links, np.int32)

    @property
    def indivisible(self) -> str:
        """Name what keeps threads of a GPU from sharing an environment, if anything does."""
        if self.pairs:
            return "rows between two bodies"
        if self.transmissions:
            return "actuators on fixed tendons or at sites"
        return "free bodies with implicitfast" if len(self.free_bodies) else ""

    @property
    def moves_origin(self) -> Index:
        """Mark links (nlink,) that carry the origin of their tree's spatial vectors, beside other trees: its root.

        Of massless slides in a row, such as a free joint's, all do. So no digits are lost far from the world's origin.
        """
        marks = np.zeros(self.nlink, np.int32)
        busy = np.isin(range(self.nlink), [*self.contact_link, *(self.pairs.link.flat if self.pairs else [])])
        busy |= (self.mass > 0) | (np.bincount(self.parent[1:], minlength=self.nlink) > 1)
        for link, parent in enumerate(self.parent.tolist()):
            passed = self.slide[link] and self.slide[parent] and not busy[parent]
            marks[link] = link > 0 and (parent == 0 or (marks[parent] and passed))
        return marks

    @property
    def root(self) -> RootCoordinates:
        """Find the coordinates in qpos that move the root."""
        position, frame, along, up = np.zeros(3), np.eye(3), np.zeros(self.nq), np.zeros(self.nq)
        if self.floating:
            along[0] = up[2] = 1.0
        for link in range(1, self.carrier + 1):  # slides, which turn nothing
            position += frame @ (self.position[link] - self.joint_ref[link] * self.rotation[link] @ self.axis[link])
            frame = frame @ self.rotation[link]
            axis = frame @ self.axis[link]
            along[link - 1] = axis[0]
            if abs(axis[2]) > 1 - 1e-9:
                up[link - 1] = np.sign(axis[2])
        return RootCoordinates(position, along, up)

    @property
    def inert(self) -> int:
        """Return the number of links after the fixed base without mass, contact or muscle: a planar robot's slides."""
        busy = (self.mass > 0) | self.inertia.any((1, 2))
        busy[[*self.contact_link, *self.segment_link.flatten()]] = True
        return 0 if self.floating else int((np.cumsum(busy[1:]) == 0).sum())

    def with_penalty(self, constants: Mapping[str, float]) -> Scene:
        """Return a copy with some of PENALTY_CONSTANTS replaced, those of limits at every joint.

        Raises:
            ValueError: an unknown constant, or one that is negative or not finite.
        """
        for name, value in constants.items():
            if name not in PENALTY_CONSTANTS:
                raise ValueError(f"unknown penalty constant {name!r}; choose from {', '.join(PENALTY_CONSTANTS)}")
            if not isinstance(value, Real) or not 0 <= value <= float(np.finfo(np.float32).max):
                raise ValueError(f"penalty constant {name} is {value!r}, must be finite and not negative")
        changes: dict[str, Any] = {
            name: np.full(self.nlink, value) if name.endswith("_limit") else value for name, value in constants.items()
        }
        return dataclasses.replace(self, **changes)

    def with_terrain(self, vertices: ArrayLike) -> Scene:
        """Return a copy whose ground is a profile z(x), the same at every y, instead of the plane.

        Args:
            vertices: (x, z) in the world [m], joined by straight segments whose first and last go on for ever:
                (K, 2) for all environments, or (num_envs, K, 2). K is 2 or more. Of two vertices of equal x the
                segment is a wall.

        Raises:
            TerrainError: another shape, numbers that are not finite, x that decreases, walls at an end or back to
                back, or a robot that touches no ground.
        """
        if not self.ncontact:
            raise TerrainError(f"{self.name} touches no ground, so it has no terrain")
        return dataclasses.replace(self, terrain=check_terrain(vertices), ground_height=0.0)

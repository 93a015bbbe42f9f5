"""Model: a scene's numbers as the kernels read them, and the structs in which the kernels keep theirs."""

from collections.abc import Callable, Iterable, Sequence
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from diffsim.kernels.thread.division import Division
from diffsim.kernels.thread.records import OPTIONAL_FIELDS, add_constraints, parts_of
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.robot.fluid import drag
from diffsim.robot.scene import Scene


class _Entries:
    """Arranges a scene's arrays by entry, the order in which the lanes read them.

    Each lane has a row of `slots` entries, one per link. The last ones are unused where a lane has fewer links.
    """

    def __init__(self, scene: Scene, division: Division) -> None:
        self.scene, self.division = scene, division
        threads, slots = division.threads_per_env, division.slots
        self.link = padded(division.links, slots)  # (entries,)
        self.lane = np.repeat(np.arange(threads), slots)  # (entries,)
        self.slot = np.zeros((threads, scene.nlink), np.int32)  # where a lane has a link
        for lane, row in enumerate(division.links):
            self.slot[lane, row] = np.arange(len(row))
        masses = division.masses
        self.owned = np.array([i in masses[lane] for lane, i in zip(self.lane, self.link, strict=True)], float)
        self.axis = np.einsum("nij,nj->ni", scene.rotation, scene.axis)
        self.position = scene.position - np.where(scene.slide, scene.joint_ref, 0.0)[:, None] * self.axis
        self.balls = [np.flatnonzero(scene.ball[row] == 0).tolist() for row in division.links]

    def to_slots(self, links: np.ndarray) -> np.ndarray:
        """Return for each entry the slot of the link that its own link points to, in its lane."""
        return self.slot[self.lane, links[self.link]]

    def ball_link(self, k: int) -> np.ndarray:
        """Return the k-th link of the ball joint that each link belongs to, or the link itself."""
        return np.arange(self.scene.nlink) + np.where(self.scene.ball < 0, 0, k - self.scene.ball)

    def masked(self, values: np.ndarray) -> np.ndarray:
        """Return the links' values by entry, zero on lanes that do not own the link's mass."""
        values = values[self.link]
        return values * self.owned.reshape(-1, *[1] * (values.ndim - 1))

    @cached_property
    def joint_rotations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Expand Rodrigues' formula for the angle q - ref by the sum formulas, so that kernels need no reference."""
        s = self.scene
        skew = np.cross(np.eye(3)[None], s.axis[:, None])  # skew(a) b = a x b
        hinge = np.where(s.slide | (s.ball >= 0), 0.0, 1.0)[:, None, None]
        r, square = s.rotation, skew @ skew
        cos, sin = np.cos(s.joint_ref)[:, None, None], np.sin(s.joint_ref)[:, None, None]
        return (
            (r @ (np.eye(3) + hinge * square))[self.link],
            (hinge * (r @ (skew * cos - square * sin)))[self.link],
            (-hinge * (r @ (square * cos + skew * sin)))[self.link],
        )

    @cached_property
    def motor_slot(self) -> np.ndarray:
        return self.slot[:, self.scene.motor_link]

    @cached_property
    def motor_lane(self) -> np.ndarray:
        lane = (self.motor_slot > 0).argmax(0)
        for k, share in enumerate(self.division.muscles):
            lane[share] = k
        return lane

    @cached_property
    def segments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sort segments by lane, then by the pair of links that they join.

        Returns:
            their order; the pairs (lane, i, j); where each pair's segments begin.
        """
        key = np.column_stack([self.motor_lane[self.scene.segment_muscle], self.scene.segment_link])
        order = np.lexsort(key.T[::-1])
        pairs, start = np.unique(key[order], axis=0, return_index=True)
        return order, pairs, np.append(start, len(order))

    @cached_property
    def spheres(self) -> tuple[np.ndarray, np.ndarray]:
        return self.group_by_entry(self.division.spheres, self.scene.contact_link)

    @cached_property
    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Assign each body to the lane that owns its link's mass."""
        link = self.scene.body_link
        return self.group_by_entry([np.flatnonzero(np.isin(link, row)) for row in self.division.masses], link)

    def group_by_entry(self, shares: Sequence[Iterable[int]], link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sort the elements that each lane has on its links; returns where each entry's begin, and the elements."""
        slots = self.division.slots
        rows = [(lane * slots + self.slot[lane, link[k]], k) for lane, share in enumerate(shares) for k in share]
        entry, elements = np.array(sorted(rows), int).reshape(-1, 2).T
        return np.searchsorted(entry, np.arange(len(self.link) + 1)), elements

    @cached_property
    def terrain(self) -> np.ndarray:
        vertices = np.zeros((1, 1, 2)) if self.scene.terrain is None else self.scene.terrain
        along = np.diff(vertices, axis=1, append=vertices[:, -1:])
        along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), np.finfo(float).tiny)
        return np.concatenate([vertices, along], 2)


Field = tuple[str, Callable[[_Entries], Any]]


def _links(kind: str, names: str) -> dict[str, Field]:
    """Read the scene's fields at each entry's link."""
    return {name: (kind, lambda n, name=name: getattr(n.scene, name)[n.link]) for name in names.split()}


def _owned(kind: str, names: str) -> dict[str, Field]:
    """Read the same, but zero on lanes that do not own the link's mass."""
    return {name: (kind, lambda n, name=name: n.masked(getattr(n.scene, name))) for name in names.split()}


def _scenes(kind: str, names: str) -> dict[str, Field]:
    """Read the scene's fields as they are."""
    return {name: (kind, lambda n, name=name: getattr(n.scene, name)) for name in names.split()}


# Each field of Model: its name, its type (an array's ends in s, or ss with two dimensions), and its source; one whose
# source returns None stays empty. Arrays of links have the entry lane * slots + slot for each link of each lane.
FIELDS: dict[str, Field] = {
    "count": ("ints", lambda n: [len(row) for row in n.division.links]),  # number of links of each lane
    "link": ("ints", lambda n: n.link),  # the link's number in the scene, from which its joint's place in qvel follows
    "parent": ("ints", lambda n: n.to_slots(n.scene.parent)),  # slot of the parent
    **_links("ints", "slide"),  # 1 of a slide joint
    **_links("ints", "moves_origin"),  # 1 of a link that carries the origin of its tree, with several
    # The frame: R = R_parent (rot0 + sin q rot1 + cos q rot2)
    "rot0": ("mat3s", lambda n: n.joint_rotations[0]),  # the constant part
    "rot1": ("mat3s", lambda n: n.joint_rotations[1]),  # times sin q
    "rot2": ("mat3s", lambda n: n.joint_rotations[2]),  # times cos q
    "position": ("vec3s", lambda n: n.position[n.link]),  # m, in the parent's frame
    "axis": ("vec3s", lambda n: n.axis[n.link]),  # unit joint axis in the parent's frame
    # Ball joints, read only in scenes that have some
    "ball_count": ("ints", lambda n: [len(row) for row in n.balls]),  # number of ball joints of each lane
    "ball_slot": ("ints", lambda n: padded(n.balls, n.scene.nball)),  # slot of each one's first link
    **_links("ints", "qpos_adr"),  # the joint's place in qpos
    "inboard": ("ints", lambda n: n.to_slots(n.scene.parent[n.ball_link(0)])),  # slot of the link that holds the joint
    "outboard": ("ints", lambda n: n.to_slots(n.ball_link(2))),  # slot of the link that the joint turns
    # Inertia and the joints' laws
    "owned": ("ints", lambda n: n.owned),  # 1 on the one lane that has the link's mass
    **_owned("reals", "mass"),  # kg
    **_owned("mat3s", "inertia"),  # kg m^2, about the centre of mass
    **_links("vec3s", "com"),  # m, centre of mass in the link's frame
    **_owned("reals", "lift"),  # kg, gravity compensation, and
    **_links("vec3s", "lift_position"),  # m, where it acts
    **_links("reals", "armature damping stiffness spring_ref"),  # MuJoCo's
    **_links("reals", "lower upper k_limit d_limit"),  # the joint's range, and the law of its limits
    **_links("reals", "servo_stiffness servo_damping servo_ref force_low force_high"),  # of actuators with a forcerange
    "motor_slot": ("ints", lambda n: n.motor_slot.flatten()),  # (lane, motor), 0 if the motor's link is on another lane
    "motor_lane": ("ints", lambda n: n.motor_lane),  # the lane that writes the motor's gradient
    **_scenes("reals", "gear motor_bias"),  # force of an actuator: gear ctrl + motor_bias
    "free_body": ("ints", lambda n: n.slot[0, n.scene.free_bodies]),  # the links of gyroscope.py
    # Muscles: a segment runs from point a of link pair_link[2 k] to point b of link pair_link[2 k + 1]
    "muscle_begin": ("ints", lambda n: np.cumsum([0, *map(len, n.division.muscles)])),  # of each lane, in muscle
    "muscle": ("ints", lambda n: sum(n.division.muscles, [])),  # actuators that are muscles, by lane
    "lane_begin": (  # of each lane, in the pairs of links
        "ints",
        lambda n: np.searchsorted(n.segments[1][:, 0], np.arange(len(n.division.muscles) + 1)),
    ),
    "pair_link": ("ints", lambda n: n.slot[n.segments[1][:, :1], n.segments[1][:, 1:]].flatten()),  # slots i, j of each
    "pair_begin": ("ints", lambda n: n.segments[2]),  # of each pair, in the segments
    "segment_a": ("vec3s", lambda n: n.scene.segment_position[n.segments[0], 0]),  # m, in the frame of link i
    "segment_b": ("vec3s", lambda n: n.scene.segment_position[n.segments[0], 1]),  # m, in the frame of link j
    "segment_muscle": ("ints", lambda n: n.scene.segment_muscle[n.segments[0]]),  # the actuator that pulls
    # Contact spheres
    "contact_begin": ("ints", lambda n: n.spheres[0]),  # of each entry, in the spheres
    "contact_position": ("vec3s", lambda n: n.scene.contact_position[n.spheres[1]]),  # m, centre in the link's frame
    "contact_radius": ("reals", lambda n: n.scene.contact_radius[n.spheres[1]]),  # m
    # MuJoCo's constraints: rows of robot.types.Constraints
    "contact_params": ("vec11s", lambda n: n.scene.constraints and n.scene.constraints.contact[n.spheres[1]]),
    "contact_axis": ("vec3s", lambda n: n.scene.constraints and n.scene.constraints.axis[n.spheres[1]]),
    "limit_params": ("vec11s", lambda n: n.scene.constraints and n.scene.constraints.limit[n.link]),
    "joint_loss": ("vec3s", lambda n: n.scene.constraints and n.scene.constraints.loss[n.link]),
    # Bodies of the MJCF, for external forces
    "body_begin": ("ints", lambda n: n.bodies[0]),  # of each entry, in body
    "body": ("ints", lambda n: n.bodies[1]),  # MuJoCo's number of the body
    "body_com": ("vec3s", lambda n: n.scene.body_com[n.bodies[1]]),  # m, in the link's frame
    # Drag, see drag.py
    "drag_frame": ("mat3s", lambda n: drag(n.scene)[0][n.link]),  # principal axes in the link's frame
    "drag_viscous": ("vec3s", lambda n: n.masked(drag(n.scene)[1])),  # (a, c, 0)
    "drag_force": ("vec3s", lambda n: n.masked(drag(n.scene)[2])),  # b of each axis
    "drag_torque": ("vec3s", lambda n: n.masked(drag(n.scene)[3])),  # d of each axis
    # The ground and the world
    "terrain": ("vec4ss", lambda n: n.terrain),  # (profile, vertex): x, z, unit vector to the next vertex
    "carrier_along": ("real", lambda n: n.scene.root.position[0]),  # m, the carrier's x at q = 0
    "carrier_height": (  # m, its height above the plane at q = 0
        "real",
        lambda n: n.scene.root.position[2] - n.scene.ground_height,
    ),
    "base_damping": ("real", lambda n: n.scene.base_damping[0]),  # of a floating base
    **_scenes("vec3", "gravity"),  # m/s^2
    **_scenes("real", "k_n k_d k_t mu"),  # soft contact, see soft_contact.py
}


def struct(name: str, fields: dict[str, Any]) -> Any:
    """Make a Warp struct that has fields of these types."""
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": __name__, "__qualname__": name}))


@cache
def scene_types(dtype: type, parts: tuple[str, ...]) -> SimpleNamespace:
    """Make Warp's vector types of a scene's numbers, and the struct Model of them with these parts' OPTIONAL_FIELDS."""
    kinds: dict[str, Any] = {f"vec{n}": wp.types.vector(n, dtype) for n in (3, 4, 5, 11)}
    kinds |= {"real": dtype, "int": wp.int32, "mat3": wp.types.matrix((3, 3), dtype)}
    arrays = {f"{name}s": wp.array(dtype=kind) for name, kind in kinds.items()}
    arrays |= {f"{name}ss": wp.array2d(dtype=kind) for name, kind in kinds.items()}
    fields = dict(FIELDS)
    for part in parts:
        fields |= OPTIONAL_FIELDS[part]
    members = {name: (kinds | arrays)[kind] for name, (kind, _) in fields.items()}
    return SimpleNamespace(**kinds, Model=struct("Model", members), fields=fields)


@cache
def types(spec: KernelSpec) -> SimpleNamespace:
    """Make Warp's types in a kernel: U of a scene's numbers, T of those that differ between environments (wide.py).

    An array of a struct has the struct's name and an s.
    """
    U = spec.dtype
    T = wp.float64 if spec.block > 1 else U
    vec2, vec3, vec4, vec6 = (wp.types.vector(n, T) for n in (2, 3, 4, 6))
    mat3, mat6, quat = wp.types.matrix((3, 3), T), wp.types.matrix((6, 6), T), wp.types.quaternion(T)

    kinds = {"T": T, "vec3": vec3, "vec6": vec6, "mat3": mat3, "quat": quat}
    array2, array3 = wp.array2d(dtype=U), wp.array3d(dtype=T)  # array2: a row for each environment
    structs: dict[str, dict[str, Any]] = {
        # State and controls of a control step, or their gradients
        "Batch": {
            "qpos": array2,  # before the step
            "qvel": array2,  # before the step
            "ctrl": array2,  # in [-1, 1] over the control range
            "factors": array2,  # columns of FACTORS; no column unless the spec is varied
            "forces": array2,  # xfrc_applied, six columns per body; no column unless the spec is forced
            "qpos_out": array2,  # after the step
            "qvel_out": array2,  # after the step, and with constraints the residual of Newton's method
        },
        # What the backward pass needs of each substep
        "Checkpoint": {
            "q": array3,  # qpos
            "v": array3,  # qvel
            "a": array3,  # qacc; with constraints also qacc before damping, and jar of each contact
            "f": array3,  # factor of the mass matrix: U and 1/d of each joint, the base's Cholesky factor
        },
        # What one thread computes
        "Lane": {
            "e": int,  # the environment, or the block of environments
            "lane": int,  # the lane's number in its environment
            "at": int,  # entry of the lane's first link in Model's arrays
            "n": int,  # number of links, at the entries at .. at + n - 1
            "row": int,  # the substep's row of the checkpoint
            "factor_row": int,  # row of the factor in the checkpoint
            "store_factor": int,  # 1 if the sweep writes the factor
            "h": T,  # s, length of a substep
            # Constants of soft contact; with constraints, factors of stiffness, of D and of friction
            "k_n": T,
            "k_d": T,
            "k_t": T,
            "mu": T,
            # Factors of constants that each link has of its own, read if varied
            "k_limit": T,
            "d_limit": T,
            "mass": T,
            "motor": T,
        },
        # Kinematics of a link, about the carrier in world axes, and its joint's state
        "Link": {
            "R": mat3,  # orientation
            "x": vec3,  # m, origin
            "S": vec6,  # the joint's motion subspace (axis)
            "V": vec6,  # spatial velocity
            "q": T,  # the joint's qpos
            "qd": T,  # the joint's qvel
        },
        # Articulated-body inertia [[a, b], [b', d]] and bias force of a link and its subtree
        "Load": {
            "a": mat3,  # rotational block
            "b": mat3,  # coupling block
            "d": mat3,  # translational block
            "f": vec6,  # bias force
        },
        # Backward pass: a link and its joint
        "Node": {
            "A": vec6,  # acceleration of the link minus gravity
            "W": vec6,  # twist of the link under lambda
            "gq": T,  # gradient of the joint's position
            "gqd": T,  # gradient of the joint's velocity
            "gtau": T,  # gradient of the joint's actuator force
            "g": T,  # right-hand side of the solve
            "u": T,  # intermediate of the solve
            "lam": T,  # its solution lambda
        },
        # Backward pass: derivatives of phi with respect to quantities of a link
        "Adjoint": {
            "a": vec6,  # acceleration
            "v": vec6,  # velocity
            "w": vec6,  # W
            "p": vec6,  # pose, as a wrench
        },
        # Backward pass: a floating base
        "Base": {
            "gp": vec3,  # gradient of the position
            "gr": vec3,  # gradient of the orientation, in the body's tangent space
            "gv": vec3,  # gradient of the linear velocity
            "gw": vec3,  # gradient of the angular velocity
            "v": vec3,  # linear velocity
            "vdot": vec3,  # linear acceleration minus gravity
        },
        # Forward pass: a link and its joint
        "Motion": {
            "C": vec6,  # velocity product of the link
            "A": vec6,  # acceleration of the link; in Newton's method the step's
            "U": vec6,  # articulated inertia times S
            "dinv": T,  # 1 / (S . U + armature + implicit terms)
            "u": T,  # the joint's force minus bias, then its acceleration; in Newton's method the step's
            "motor": T,  # force of the joint's motors
            "rounding_error": T,  # what rounding took from the joint's position so far
        },
        # Forward pass: a floating base
        "Root": {
            "pos": vec3,  # m
            "rot": quat,  # orientation
            "v": vec3,  # linear velocity, world axes
            "w": vec3,  # angular velocity, body axes
            "rounding_error": vec3,  # what rounding took from pos so far
            "vdot": vec3,  # linear acceleration; in Newton's method the step's
            "wdot": vec3,  # angular acceleration; in Newton's method the step's
            "newton_vdot": vec3,  # linear acceleration of Newton's iterate
            "newton_wdot": vec3,  # angular acceleration of Newton's iterate
        },
    }
    if "trees" in spec.features:
        structs["Link"] |= {"origin": vec3}  # m, of its tree's spatial vectors, in the world
    if spec.features & {"clamp", "tendon"}:
        structs["Node"] |= {
            "motor": T,  # force of the joint's motors
            "unclamped": T,  # 1 where the actuators' force is within its bounds
        }
    add_constraints(structs, spec, T, vec3, vec4, vec6, mat3, mat6)
    kinds |= {name: struct(name, members) for name, members in structs.items()}
    return SimpleNamespace(
        **kinds,
        **{f"{name}s": wp.array(dtype=kind) for name, kind in kinds.items()},
        **{"U": U, "vec2": vec2, "vec4": vec4, "mat6": mat6, "array2": array2, "array3": array3},
        scene=scene_types(U, parts_of(spec)),
        Model=scene_types(U, parts_of(spec)).Model,
        CarrierPos=vec2 if "terrain" in spec.features else T,  # the carrier's (x, z), or its height
        Frame=mat3 if spec.framed else T,  # of a contact: E of terrain.py, or the world's, of which is 1
    )


def functions(names: dict[str, Any]) -> SimpleNamespace:
    """Select Warp's functions among a module's names: what it offers to other modules."""
    return SimpleNamespace(**{name: value for name, value in names.items() if isinstance(value, wp.Function)})


def model_of(scene: Scene, division: Division, dtype: type, device: str) -> Any:
    """Put the scene's numbers into a Model on a device."""
    t = scene_types(dtype, tuple(part for part in OPTIONAL_FIELDS if getattr(scene, part)))
    model, entries = t.Model(), _Entries(scene, division)
    for name, member in t.Model.vars.items():
        kind, values = member.type, t.fields[name][1](entries)
        if isinstance(kind, wp.array) and values is not None:
            values = np.ascontiguousarray(values, np.int32 if kind.dtype is wp.int32 else float)
            # Warp gives an empty array no address; one unread element keeps the struct uniform.
            values = values if len(values) else np.zeros((1, *values.shape[1:]), values.dtype)
            setattr(model, name, wp.array(values, dtype=kind.dtype, device=device))
        elif values is not None:
            setattr(model, name, kind(values))
    return model


def padded(rows: list[list[int]], width: int) -> np.ndarray:
    """Join the rows end to end, each filled up with zeros to the width."""
    return np.array([[*row, *[0] * (width - len(row))] for row in rows], np.int32).flatten()

"""The numbers of a scene as the kernels read them: Warp's types, and a struct of arrays on a device."""

from collections.abc import Callable, Iterable, Sequence
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from diffsim.kernels.lanes import Division
from diffsim.kernels.spec import KernelSpec
from diffsim.robot.scene import Scene


class _Numbers:
    """What fields of a Model are made of. Of each lane's links there is a row of `slots` entries, the last ones unused
    where a lane has fewer."""

    def __init__(self, scene: Scene, division: Division) -> None:
        self.scene, self.division = scene, division
        threads, slots = division.threads_per_env, division.slots
        self.link = padded(division.links, slots)  # of each entry, and
        self.lane = np.repeat(np.arange(threads), slots)
        self.slot = np.zeros((threads, scene.nlink), np.int32)  # of each lane's each link
        for lane, row in enumerate(division.links):
            self.slot[lane, row] = np.arange(len(row))
        weighs = division.weighs
        self.carried = np.array([i in weighs[lane] for lane, i in zip(self.lane, self.link, strict=True)], float)
        self.axis = np.einsum("nij,nj->ni", scene.rotation, scene.axis)
        self.position = scene.position - np.where(scene.slide, scene.joint_ref, 0.0)[:, None] * self.axis
        self.balls = [np.flatnonzero(scene.ball[row] == 0).tolist() for row in division.links]

    def slots_of(self, links: np.ndarray) -> np.ndarray:
        """Of what each link points to, where the entry's lane has it."""
        return self.slot[self.lane, links[self.link]]

    def around_ball(self, k: int) -> np.ndarray:
        """The k-th link of the ball joint that each link belongs to, or the link itself."""
        return np.arange(self.scene.nlink) + np.where(self.scene.ball < 0, 0, k - self.scene.ball)

    def carry(self, values: np.ndarray) -> np.ndarray:
        """By entry, but zero on lanes that do not carry the link's mass."""
        values = values[self.link]
        return values * self.carried.reshape(-1, *[1] * (values.ndim - 1))

    @cached_property
    def turns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rodrigues for the angle q - ref, expanded by the sum formulas: the kernels then need no reference."""
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
        for k, hand in enumerate(self.division.muscles):
            lane[hand] = k
        return lane

    @cached_property
    def segments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Their order, by lane and then by the pair of links that they join; the pairs (lane, i, j), their starts."""
        key = np.column_stack([self.motor_lane[self.scene.segment_muscle], self.scene.segment_link])
        order = np.lexsort(key.T[::-1])
        pairs, start = np.unique(key[order], axis=0, return_index=True)
        return order, pairs, np.append(start, len(order))

    @cached_property
    def spheres(self) -> tuple[np.ndarray, np.ndarray]:
        return self.by_entry(self.division.spheres, self.scene.contact_link)

    @cached_property
    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """A body is on the lane that carries its link's mass."""
        link = self.scene.body_link
        return self.by_entry([np.flatnonzero(np.isin(link, row)) for row in self.division.weighs], link)

    def by_entry(self, hands: Sequence[Iterable[int]], link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where each entry begins, and the things themselves, of things on links that are dealt to the lanes."""
        rows = [
            (lane * self.division.slots + self.slot[lane, link[k]], k) for lane, hand in enumerate(hands) for k in hand
        ]
        entry, things = np.array(sorted(rows), int).reshape(-1, 2).T
        return np.searchsorted(entry, np.arange(len(self.link) + 1)), things

    @cached_property
    def terrain(self) -> np.ndarray:
        vertices = np.zeros((1, 1, 2)) if self.scene.terrain is None else self.scene.terrain
        along = np.diff(vertices, axis=1, append=vertices[:, -1:])
        along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), np.finfo(float).tiny)
        return np.concatenate([vertices, along], 2)


Field = tuple[str, Callable[[_Numbers], Any]]


def _links(kind: str, names: str) -> dict[str, Field]:
    """Fields that are the scene's, of each entry's link."""
    return {name: (kind, lambda n, name=name: getattr(n.scene, name)[n.link]) for name in names.split()}


def _carried(kind: str, names: str) -> dict[str, Field]:
    """The same, but zero on the lanes that do not carry the link's mass."""
    return {name: (kind, lambda n, name=name: n.carry(getattr(n.scene, name))) for name in names.split()}


def _scenes(kind: str, names: str) -> dict[str, Field]:
    """Fields that are the scene's."""
    return {name: (kind, lambda n, name=name: getattr(n.scene, name)) for name in names.split()}


# The name of each field, its type (an array's ends in s, or ss with two dimensions), and where its numbers come from;
# one whose source is None stays empty. Of each lane's each link there is entry lane * slots + slot.
FIELDS: dict[str, Field] = {
    "count": ("ints", lambda n: [len(row) for row in n.division.links]),  # links of each lane
    "link": ("ints", lambda n: n.link),  # its number in the scene, which says where its joint is in qvel
    "parent": ("ints", lambda n: n.slots_of(n.scene.parent)),  # a slot, as are inboard and outboard
    **_links("ints", "slide"),
    # R = R_parent (turn0 + sin q turn1 + cos q turn2); axis and position in the parent's frame
    "turn0": ("mat3s", lambda n: n.turns[0]),
    "turn1": ("mat3s", lambda n: n.turns[1]),
    "turn2": ("mat3s", lambda n: n.turns[2]),
    "position": ("vec3s", lambda n: n.position[n.link]),
    "axis": ("vec3s", lambda n: n.axis[n.link]),
    # read in scenes with ball joints only: the first link of each ball joint; of each link its place in qpos, the
    # link that its joint hangs on, and the link that its joint turns
    "ball_count": ("ints", lambda n: [len(row) for row in n.balls]),
    "ball_slot": ("ints", lambda n: padded(n.balls, n.scene.nball)),
    **_links("ints", "qpos_adr"),
    "inboard": ("ints", lambda n: n.slots_of(n.scene.parent[n.around_ball(0)])),
    "outboard": ("ints", lambda n: n.slots_of(n.around_ball(2))),
    "carried": ("ints", lambda n: n.carried),  # 1 on the one lane that has its mass
    **_carried("reals", "mass lift"),  # lift: read with gravity compensation only
    **_carried("mat3s", "inertia"),
    **_links("vec3s", "com lift_position"),
    **_links("reals", "armature damping stiffness spring_ref lower upper k_limit d_limit"),
    **_links(
        "reals", "servo_stiffness servo_damping servo_ref force_low force_high"
    ),  # read where actuators have bounds
    "motor_slot": ("ints", lambda n: n.motor_slot.flatten()),  # of each lane's each motor, 0 if another has its link
    "motor_lane": ("ints", lambda n: n.motor_lane),  # the lane that writes its gradient
    **_scenes("reals", "gear motor_bias"),
    # segments of muscles, from a in the frame of pair_link[2 k] to b in that of pair_link[2 k + 1];
    # a lane's muscles are muscle[muscle_begin[lane]] .. muscle[muscle_begin[lane + 1] - 1]
    "muscle_begin": ("ints", lambda n: np.cumsum([0, *map(len, n.division.muscles)])),
    "muscle": ("ints", lambda n: sum(n.division.muscles, [])),
    # its pairs of links are lane_begin[lane] .. lane_begin[lane + 1], the segments of pair k are pair_begin[k] ..
    "lane_begin": ("ints", lambda n: np.searchsorted(n.segments[1][:, 0], np.arange(len(n.division.muscles) + 1))),
    "pair_link": ("ints", lambda n: n.slot[n.segments[1][:, :1], n.segments[1][:, 1:]].flatten()),
    "pair_begin": ("ints", lambda n: n.segments[2]),
    "segment_a": ("vec3s", lambda n: n.scene.segment_position[n.segments[0], 0]),
    "segment_b": ("vec3s", lambda n: n.scene.segment_position[n.segments[0], 1]),
    "segment_muscle": ("ints", lambda n: n.scene.segment_muscle[n.segments[0]]),
    "contact_begin": (
        "ints",
        lambda n: n.spheres[0],
    ),  # spheres of entry k are contact_begin[k] .. contact_begin[k + 1]
    "contact_position": ("vec3s", lambda n: n.scene.contact_position[n.spheres[1]]),
    "contact_radius": ("reals", lambda n: n.scene.contact_radius[n.spheres[1]]),
    # MuJoCo's constraints, read by the integrator mujoco only: robot/constraint.py has their order
    "contact_numbers": ("vec11s", lambda n: n.scene.constraints and n.scene.constraints.contact[n.spheres[1]]),
    "limit_numbers": ("vec11s", lambda n: n.scene.constraints and n.scene.constraints.limit[n.link]),
    "joint_loss": ("vec3s", lambda n: n.scene.constraints and n.scene.constraints.loss[n.link]),
    "body_begin": ("ints", lambda n: n.bodies[0]),  # bodies of entry k are body_begin[k] .. body_begin[k + 1]
    "body": ("ints", lambda n: n.bodies[1]),
    "body_com": ("vec3s", lambda n: n.scene.body_com[n.bodies[1]]),
    "drag_frame": ("mat3s", lambda n: n.scene.drag[0][n.link]),  # principal axes in the link's frame, see drag.py
    "drag_viscous": ("vec3s", lambda n: n.carry(n.scene.drag[1])),  # (a, c, 0)
    "drag_force": ("vec3s", lambda n: n.carry(n.scene.drag[2])),
    "drag_torque": ("vec3s", lambda n: n.carry(n.scene.drag[3])),
    # read in scenes with a terrain only: a row of each profile, or one for all environments, whose vertices are
    # (x, z, unit vector along the segment that begins there)
    "terrain": ("vec4ss", lambda n: n.terrain),
    "carrier_along": ("real", lambda n: n.scene.root[0][0]),  # x at q = 0
    # over the ground at q = 0 (fixed base), or minus the ground's height (floating)
    "carrier_height": ("real", lambda n: n.scene.root[0][2] - n.scene.ground_height),
    "base_damping": ("real", lambda n: n.scene.base_damping[0]),
    **_scenes("vec3", "gravity"),
    **_scenes("real", "k_n k_d k_t mu"),
}


def struct(name: str, fields: dict[str, Any]) -> Any:
    """A Warp struct that has fields of these types."""
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": __name__, "__qualname__": name}))


@cache
def scene_types(dtype: type) -> SimpleNamespace:
    """Warp's vector types of a scene's numbers, and their struct."""
    kinds: dict[str, Any] = {f"vec{n}": wp.types.vector(n, dtype) for n in (3, 4, 11)}
    kinds |= {"real": dtype, "int": wp.int32, "mat3": wp.types.matrix((3, 3), dtype)}
    arrays = {f"{name}s": wp.array(dtype=kind) for name, kind in kinds.items()}
    arrays |= {f"{name}ss": wp.array2d(dtype=kind) for name, kind in kinds.items()}
    return SimpleNamespace(
        **kinds, Model=struct("Model", {name: (kinds | arrays)[kind] for name, (kind, _) in FIELDS.items()})
    )


@cache
def types(spec: KernelSpec) -> SimpleNamespace:
    """Warp's types in a kernel: U of a scene's numbers, T of those that environments have of their own (wide.py).

    An array of a struct has the struct's name and an s.
    """
    U = spec.dtype
    T = wp.float64 if spec.block > 1 else U
    vec2, vec3, vec4, vec6 = (wp.types.vector(n, T) for n in (2, 3, 4, 6))
    mat3, mat6, quat = wp.types.matrix((3, 3), T), wp.types.matrix((6, 6), T), wp.types.quaternion(T)

    kinds = {"T": T, "vec3": vec3, "vec6": vec6, "mat3": mat3, "quat": quat}

    def of(**rows: str) -> dict[str, Any]:
        return {name: kinds[kind] for kind, names in rows.items() for name in names.split()}

    array2, array3 = wp.array2d(dtype=U), wp.array3d(dtype=T)  # array2: a row for each environment
    structs: dict[str, dict[str, Any]] = {
        # what a step takes and gives, or its gradients; forces and factors have no columns unless they vary
        "Batch": dict.fromkeys("qpos qvel ctrl factors forces qpos_out qvel_out".split(), array2),
        # what backward needs of each substep: qpos, qvel, qacc and the factor of the mass matrix
        "Checkpoint": dict.fromkeys("qvaf", array3),
        # a lane of an environment, or of a block of them, e; its n links are entries at, at + 1, ... of Model's arrays;
        # rows of checkpoints: the substep's, and the factor's, which is kept if keep is 1; h: s, of a substep;
        # constants of the laws, or factors of those that each link has its own of (k_limit to motor, read where they
        # vary)
        "Lane": dict.fromkeys("e lane at n row factor keep".split(), int)
        | of(T="h k_n k_d k_t mu k_limit d_limit mass motor"),
        # where a link is (about the carrier, in world axes), its joint's axis, its velocity, and its joint's state
        "Link": of(mat3="R", vec3="x", vec6="S V", T="q qd"),
        # what a link hands to its parent: its inertia [[a, b], [b', d]] and bias force
        "Load": of(mat3="a b d", vec6="f"),
        # what backward keeps of a link and its joint: the link's acceleration A and twist W under lambda; the gradients
        # of the joint's position, rate and force; right-hand side, intermediate and solution of the solve; the motors'
        # force, and 1 where it is within its bounds; with constraints the twist B of constraint.py and the acceleration
        # before damping, which adds D to B and has a twist W1 of its own
        "Node": of(vec6="A W", T="gq gqd gtau g u lam"),
        # the adjoints of a link's acceleration, velocity, W and pose, of B, D and W1
        "Adjoint": of(vec6="a v w p"),
        # gradients of a floating base's position, turn and velocities, its linear velocity and acceleration
        "Base": of(vec3="gp gr gv gw v vdot"),
        # what the forward kernel keeps of a link and its joint: the link's velocity product C and acceleration A, with
        # constraints that of a step; the factor U and 1/d, the right-hand side u and then the acceleration, the motors'
        # force, what rounding the position lost. In Newton's method the link's acceleration so far (iterate), the
        # joint's (rate), the force on it without constraints, theirs (held; firm: minus its slope), theirs where a part
        # of the step is tried (holds; given: the slope's share), and the limit's stop
        "Motion": of(vec6="C A U", T="dinv u motor rest"),
        # a floating base's state, accelerations or steps of a solve, and the iterate
        "Root": of(vec3="pos", quat="rot") | of(vec3="v w rest speeding_up turning_up vdot wdot"),
        # where Newton's method is: 1 for environments that have not converged, else 0; squares of the residual and of
        # the acceleration (plus 1); passes so far
        "Newton": of(T="tolerance going off size") | {"passes": int},
        # where a contact is, jar and force of the iterate and where a part of the step is tried, H step, the cone's H
        # there, D, and whether it touches
        "Contact": of(vec3="p jar f tried pushes Hs", mat3="H", T="D on"),
    }
    if "clamp" in spec.features:
        structs["Node"] |= of(T="motor free")
    if spec.constrained:
        structs["Node"] |= of(vec6="B", T="rate")
        structs["Adjoint"] |= of(vec6="b")
        structs["Motion"] |= of(vec6="iterate", vec3="stop", T="rate force held firm holds given")
    if spec.damped:
        structs["Node"] |= of(vec6="D W1")
        structs["Adjoint"] |= of(vec6="d w1")
    if "terrain" in spec.features:
        structs["Contact"] |= of(mat3="E")  # the frame in which jar, forces and H are
    kinds |= {name: struct(name, members) for name, members in structs.items()}
    return SimpleNamespace(
        **kinds,
        **{f"{name}s": wp.array(dtype=kind) for name, kind in kinds.items()},
        **{"U": U, "vec2": vec2, "vec4": vec4, "mat6": mat6, "array2": array2, "array3": array3},
        scene=scene_types(U),
        Model=scene_types(U).Model,
        Place=vec2 if "terrain" in spec.features else T,  # the carrier's: (x, z), or its height
        Frame=mat3 if "terrain" in spec.features else T,  # of a contact: E of terrain.py, or the world's, of which is 1
    )


def functions(names: dict[str, Any]) -> SimpleNamespace:
    """What a module of the kernels offers to others: Warp's functions among its names."""
    return SimpleNamespace(**{name: value for name, value in names.items() if isinstance(value, wp.Function)})


def model_of(scene: Scene, division: Division, dtype: type, device: str) -> Any:
    """The scene's numbers as a Warp struct on a device."""
    Model, numbers = scene_types(dtype).Model, _Numbers(scene, division)
    model = Model()
    for name, (_, source) in FIELDS.items():
        kind, values = Model.vars[name].type, source(numbers)
        if isinstance(kind, wp.array) and values is not None:
            values = np.ascontiguousarray(values, np.int32 if kind.dtype is wp.int32 else float)
            # Warp gives an empty array no address; one unread element keeps the struct uniform.
            values = values if len(values) else np.zeros((1, *values.shape[1:]), values.dtype)
            setattr(model, name, wp.array(values, dtype=kind.dtype, device=device))
        elif values is not None:
            setattr(model, name, kind(values))
    return model


def padded(rows: list[list[int]], width: int) -> np.ndarray:
    """The rows end to end, each filled up with zeros."""
    return np.array([[*row, *[0] * (width - len(row))] for row in rows], np.int32).flatten()

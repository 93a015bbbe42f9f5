"""What the kernels read: the shape of a scene, which decides their code, and its numbers, which do not."""

import dataclasses
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from diffsim.kernels.lanes import divide
from diffsim.scene import Scene

MAX_SPEED = 1e5  # m/s and rad/s; what is faster has blown up, and its squares would soon leave float32


@dataclasses.dataclass(frozen=True)
class Shape:
    """Everything the generated code depends on. Scenes of equal shape share their compiled kernels."""

    nlink: int
    nu: int
    carrier: int
    nball: int
    features: frozenset[str]
    dtype: type
    implicit: bool
    env_last: bool  # checkpoints as [row, component, environment] (coalesced on a GPU) or [row, environment, component]
    # how threads share an environment (lanes.py); slots: the most links that one of them has
    lanes: int
    sharers: int
    trunk: int
    slots: int
    inert: int  # slots after the fixed base whose links carry nothing, so that their own inertia need not be computed

    @property
    def floating(self) -> bool:
        return "floating" in self.features

    @property
    def dof0(self) -> int:
        """Degrees of freedom of the base: joint i is dof0 + i - 1 in qvel."""
        return 6 if self.floating else 0

    @property
    def nv(self) -> int:
        return self.dof0 + self.nlink - 1

    @property
    def nq(self) -> int:
        return self.nv + int(self.floating) + self.nball

    @property
    def nfactor(self) -> int:
        """Numbers of the cached factorisation: U and 1/d of each joint, the base's packed Cholesky factor."""
        return 7 * (self.nlink - 1) + (21 if self.floating else 0)


def shape_of(scene: Scene, dtype: type, implicit: bool, env_last: bool, lanes: int = 1, sharers: int = 1) -> Shape:
    d = divide(scene, lanes, sharers)
    base = (scene.nlink, scene.nu, scene.carrier, scene.nball, scene.features)
    inert = scene.inert if lanes == sharers else min(scene.inert, d.trunk)
    return Shape(*base, dtype, implicit, env_last, lanes, sharers, d.trunk, d.slots, inert)


def module_options(shape: Shape) -> dict[str, Any]:
    # On the CPU unrolling buys no speed and costs a second of compilation; a GPU keeps small matrices in registers.
    return {"enable_backward": False, "max_unroll": 6 if shape.env_last else 1}


@cache
def types(dtype: type) -> SimpleNamespace:
    """Warp's vector types of one precision, and the struct of a scene's numbers."""
    vec3, mat3, vec9 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype), wp.types.vector(9, dtype)

    @wp.struct
    class Model:
        # of each lane's each link: entry lane * slots + slot; parent, inboard and outboard are slots
        count: wp.array(dtype=int)  # links of each lane
        link: wp.array(dtype=int)  # its number in the scene, which says where its joint is in qvel
        parent: wp.array(dtype=int)
        slide: wp.array(dtype=int)
        # R = R_parent (turn0 + sin q turn1 + cos q turn2); axis and position in the parent's frame
        turn0: wp.array(dtype=mat3)
        turn1: wp.array(dtype=mat3)
        turn2: wp.array(dtype=mat3)
        position: wp.array(dtype=vec3)
        axis: wp.array(dtype=vec3)
        # read in scenes with ball joints only: the first link of each ball joint; of each link its place in qpos, the
        # link that its joint hangs on, and the link that its joint turns
        ball_count: wp.array(dtype=int)
        ball_slot: wp.array(dtype=int)
        qpos_adr: wp.array(dtype=int)
        inboard: wp.array(dtype=int)
        outboard: wp.array(dtype=int)
        mass: wp.array(dtype=dtype)
        com: wp.array(dtype=vec3)
        inertia: wp.array(dtype=mat3)
        armature: wp.array(dtype=dtype)
        damping: wp.array(dtype=dtype)
        stiffness: wp.array(dtype=dtype)
        spring_ref: wp.array(dtype=dtype)
        lower: wp.array(dtype=dtype)
        upper: wp.array(dtype=dtype)
        motor_slot: wp.array(dtype=int)  # of each lane's each motor, 0 where another lane has its link
        motor_lane: wp.array(dtype=int)  # the lane that writes its gradient
        gear: wp.array(dtype=dtype)
        motor_bias: wp.array(dtype=dtype)
        # segments of muscles, from a in the frame of pair_link[2 k] to b in that of pair_link[2 k + 1]
        muscle_begin: wp.array(
            dtype=int
        )  # a lane's muscles are entries muscle_begin[lane] .. muscle_begin[lane + 1] of
        muscle: wp.array(dtype=int)
        lane_begin: wp.array(dtype=int)  # its pairs of links are lane_begin[lane] .. lane_begin[lane + 1]
        pair_link: wp.array(dtype=int)
        pair_begin: wp.array(dtype=int)  # the segments of pair k are pair_begin[k] .. pair_begin[k + 1]
        segment_a: wp.array(dtype=vec3)
        segment_b: wp.array(dtype=vec3)
        segment_muscle: wp.array(dtype=int)
        hill: wp.array(dtype=vec9)
        contact_begin: wp.array(dtype=int)  # spheres of entry k are contact_begin[k] .. contact_begin[k + 1]
        contact_position: wp.array(dtype=vec3)
        contact_radius: wp.array(dtype=dtype)
        drag_frame: wp.array(dtype=mat3)  # principal axes in the link's frame, see drag.py
        drag_viscous: wp.array(dtype=vec3)  # (a, c, 0)
        drag_force: wp.array(dtype=vec3)
        drag_torque: wp.array(dtype=vec3)
        gravity: vec3
        carrier_height: dtype  # over the ground at q = 0 (fixed base), or minus the ground's height (floating)
        k_n: dtype
        k_d: dtype
        k_t: dtype
        mu: dtype
        k_limit: dtype
        d_limit: dtype

    return SimpleNamespace(
        dtype=dtype,
        vec3=vec3,
        mat3=mat3,
        vec4=wp.types.vector(4, dtype),
        vec6=wp.types.vector(6, dtype),
        vec9=vec9,
        mat6=wp.types.matrix((6, 6), dtype),
        quat=wp.types.quaternion(dtype),
        array=wp.array(dtype=dtype),
        array2=wp.array2d(dtype=dtype),
        array3=wp.array3d(dtype=dtype),
        Model=Model,
    )


def model_of(scene: Scene, dtype: type, device: str, lanes: int = 1, sharers: int = 1) -> Any:
    """The scene's numbers as a Warp struct on a device."""
    t = types(dtype)
    model = t.Model()

    def put(values: Any, kind: type) -> wp.array:
        values = np.ascontiguousarray(values)
        # Warp gives an empty array no address; one unread element keeps the struct uniform.
        return wp.array(values if len(values) else np.zeros((1, *values.shape[1:])), dtype=kind, device=device)

    def padded(rows: list[list[int]], width: int) -> np.ndarray:
        return np.array([[*row, *[0] * (width - len(row))] for row in rows], np.int32).flatten()

    # The entries of all lanes in a row: which link each is, and of which lane; of each lane the slot of each link.
    d = divide(scene, lanes, sharers)
    links, lane_of = padded(d.links, d.slots), np.repeat(np.arange(lanes), d.slots)
    slot = np.zeros((lanes, scene.nlink), np.int32)
    for lane, row in enumerate(d.links):
        slot[lane, row] = np.arange(len(row))
    carried = np.array([link in d.weighs[lane] for lane, link in zip(lane_of, links, strict=True)], float)

    def put_links(values: Any, kind: type) -> wp.array:
        return put(values[links], kind)

    skew = np.cross(np.eye(3)[None], scene.axis[:, None])  # skew(a) b = a x b
    hinge = np.where(scene.slide | (scene.ball >= 0), 0.0, 1.0)[:, None, None]
    r, square = scene.rotation, skew @ skew
    cos, sin = np.cos(scene.joint_ref)[:, None, None], np.sin(scene.joint_ref)[:, None, None]
    axis = np.einsum("nij,nj->ni", r, scene.axis)
    # Rodrigues for the angle q - ref, expanded by the sum formulas: the kernels then need no reference.
    model.turn0 = put_links(r @ (np.eye(3) + hinge * square), t.mat3)
    model.turn1 = put_links(hinge * (r @ (skew * cos - square * sin)), t.mat3)
    model.turn2 = put_links(-hinge * (r @ (square * cos + skew * sin)), t.mat3)
    position = scene.position - np.where(scene.slide, scene.joint_ref, 0.0)[:, None] * axis
    model.position, model.axis = put_links(position, t.vec3), put_links(axis, t.vec3)
    model.count, model.link = put(np.array([len(row) for row in d.links], np.int32), int), put(links, int)
    model.parent, model.slide = (
        put(slot[lane_of, scene.parent[links]], int),
        put_links(scene.slide.astype(np.int32), int),
    )
    first, last = (np.arange(scene.nlink) + np.where(scene.ball < 0, 0, k - scene.ball) for k in (0, 2))
    model.qpos_adr, model.inboard = put_links(scene.qpos_adr, int), put(slot[lane_of, scene.parent[first][links]], int)
    model.outboard = put(slot[lane_of, last[links]], int)
    balls = [np.flatnonzero(scene.ball[row] == 0).tolist() for row in d.links]
    model.ball_count = put(np.array([len(row) for row in balls], np.int32), int)
    model.ball_slot = put(padded(balls, scene.nball), int)
    model.com, model.mass = put_links(scene.com, t.vec3), put(scene.mass[links] * carried, dtype)
    model.inertia = put(scene.inertia[links] * carried[:, None, None], t.mat3)
    for name in ("armature", "damping", "stiffness", "spring_ref", "lower", "upper"):
        setattr(model, name, put_links(getattr(scene, name), dtype))
    model.gear, model.motor_bias = put(scene.gear, dtype), put(scene.motor_bias, dtype)
    model.motor_slot = put(slot[:, scene.motor_link].flatten(), int)
    writer = (slot[:, scene.motor_link] > 0).argmax(0)
    for lane, hand in enumerate(d.muscles):
        writer[hand] = lane
    model.motor_lane = put(writer.astype(np.int32), int)
    # Segments by lane, then by the pair of links that they join.
    lane_of_segment = writer[scene.segment_muscle] if len(scene.segment_muscle) else np.zeros(0, int)
    key = np.column_stack([lane_of_segment, scene.segment_link])
    order = np.lexsort(key.T[::-1])
    pairs, start = np.unique(key[order], axis=0, return_index=True)
    model.muscle_begin = put(np.cumsum([0, *map(len, d.muscles)]).astype(np.int32), int)
    model.muscle = put(np.array(sum(d.muscles, []), np.int32), int)
    model.lane_begin = put(np.searchsorted(pairs[:, 0], np.arange(lanes + 1)).astype(np.int32), int)
    model.pair_link = put(slot[pairs[:, :1], pairs[:, 1:]].flatten(), int)
    model.pair_begin = put(np.append(start, len(order)).astype(np.int32), int)
    model.segment_a, model.segment_b = (put(scene.segment_position[order, end], t.vec3) for end in (0, 1))
    model.segment_muscle, model.hill = put(scene.segment_muscle[order], int), put(scene.hill, t.vec9)
    # Contact spheres by lane, then by slot.
    rows = [
        (lane * d.slots + slot[lane, scene.contact_link[k]], k) for lane, hand in enumerate(d.spheres) for k in hand
    ]
    entry, sphere = np.array(sorted(rows), int).reshape(-1, 2).T
    model.contact_begin = put(np.searchsorted(entry, np.arange(len(links) + 1)).astype(np.int32), int)
    model.contact_position = put(scene.contact_position[sphere], t.vec3)
    model.contact_radius = put(scene.contact_radius[sphere], dtype)
    frame, *coefficients = scene.drag
    model.drag_frame = put_links(frame, t.mat3)
    for name, value in zip(("drag_viscous", "drag_force", "drag_torque"), coefficients, strict=True):
        setattr(model, name, put(value[links] * carried[:, None], t.vec3))
    model.gravity = t.vec3(*scene.gravity)
    # Along the chain of slides that ends at the carrier nothing turns, so the offsets add up as they are.
    frame, height = np.eye(3), 0.0
    for i in range(1, scene.carrier + 1):
        height += (frame @ position[i])[2]
        frame = frame @ r[i]
    model.carrier_height = dtype(height - scene.ground_height)
    for name in ("k_n", "k_d", "k_t", "mu", "k_limit", "d_limit"):
        setattr(model, name, dtype(getattr(scene, name)))
    return model

"""The numbers of a scene as the kernels read them: Warp's types, and a struct of arrays on a device."""

from collections.abc import Iterable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from diffsim.kernels.lanes import Division
from diffsim.kernels.spec import KernelSpec
from diffsim.robot.scene import Scene


@cache
def scene_types(dtype: type) -> SimpleNamespace:
    """Warp's vector types of a scene's numbers, and their struct."""
    vec3, vec4, vec11 = (wp.types.vector(n, dtype) for n in (3, 4, 11))
    mat3 = wp.types.matrix((3, 3), dtype)

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
        carried: wp.array(dtype=int)  # 1 on the one lane that has its mass
        mass: wp.array(dtype=dtype)
        com: wp.array(dtype=vec3)
        inertia: wp.array(dtype=mat3)
        lift: wp.array(dtype=dtype)  # read with gravity compensation only
        lift_position: wp.array(dtype=vec3)
        base_damping: wp.array(dtype=dtype)  # read where a floating base has some
        armature: wp.array(dtype=dtype)
        damping: wp.array(dtype=dtype)
        stiffness: wp.array(dtype=dtype)
        spring_ref: wp.array(dtype=dtype)
        # read where actuators have bounds only
        servo_stiffness: wp.array(dtype=dtype)
        servo_damping: wp.array(dtype=dtype)
        servo_ref: wp.array(dtype=dtype)
        force_low: wp.array(dtype=dtype)
        force_high: wp.array(dtype=dtype)
        lower: wp.array(dtype=dtype)
        upper: wp.array(dtype=dtype)
        k_limit: wp.array(dtype=dtype)
        d_limit: wp.array(dtype=dtype)
        motor_slot: wp.array(dtype=int)  # of each lane's each motor, 0 where another lane has its link
        motor_lane: wp.array(dtype=int)  # the lane that writes its gradient
        gear: wp.array(dtype=dtype)
        motor_bias: wp.array(dtype=dtype)
        # segments of muscles, from a in the frame of pair_link[2 k] to b in that of pair_link[2 k + 1];
        # a lane's muscles are muscle[muscle_begin[lane]] .. muscle[muscle_begin[lane + 1] - 1]
        muscle_begin: wp.array(dtype=int)
        muscle: wp.array(dtype=int)
        lane_begin: wp.array(dtype=int)  # its pairs of links are lane_begin[lane] .. lane_begin[lane + 1]
        pair_link: wp.array(dtype=int)
        pair_begin: wp.array(dtype=int)  # the segments of pair k are pair_begin[k] .. pair_begin[k + 1]
        segment_a: wp.array(dtype=vec3)
        segment_b: wp.array(dtype=vec3)
        segment_muscle: wp.array(dtype=int)
        contact_begin: wp.array(dtype=int)  # spheres of entry k are contact_begin[k] .. contact_begin[k + 1]
        contact_position: wp.array(dtype=vec3)
        contact_radius: wp.array(dtype=dtype)
        # MuJoCo's constraints, read by the integrator mujoco only: robot/constraint.py has their order
        contact_numbers: wp.array(dtype=vec11)
        limit_numbers: wp.array(dtype=vec11)
        joint_loss: wp.array(dtype=vec3)
        body_begin: wp.array(dtype=int)  # bodies of entry k are body_begin[k] .. body_begin[k + 1]
        body: wp.array(dtype=int)
        body_com: wp.array(dtype=vec3)
        drag_frame: wp.array(dtype=mat3)  # principal axes in the link's frame, see drag.py
        drag_viscous: wp.array(dtype=vec3)  # (a, c, 0)
        drag_force: wp.array(dtype=vec3)
        drag_torque: wp.array(dtype=vec3)
        # read in scenes with a terrain only: a row of each profile, or one for all environments, whose vertices are
        # (x, z, unit vector along the segment that begins there)
        terrain: wp.array2d(dtype=vec4)
        carrier_along: dtype  # x at q = 0
        gravity: vec3
        carrier_height: dtype  # over the ground at q = 0 (fixed base), or minus the ground's height (floating)
        k_n: dtype
        k_d: dtype
        k_t: dtype
        mu: dtype

    return SimpleNamespace(vec3=vec3, vec4=vec4, vec11=vec11, mat3=mat3, Model=Model)


@cache
def types(spec: KernelSpec) -> SimpleNamespace:
    """Warp's types in a kernel: U of a scene's numbers, T of those that environments have of their own (wide.py)."""
    U = spec.dtype
    T = wp.float64 if spec.block > 1 else U

    @wp.struct
    class Law:
        h: T  # s, of a substep
        theta: T  # how implicit it is
        k_n: T
        k_d: T
        k_t: T
        mu: T
        # factors of what each link has its own of, read where they vary only
        k_limit: T
        d_limit: T
        mass: T
        motor: T
        block: int  # whose environments' rows of Model.terrain are read where there is one only

    @wp.struct
    class Load:  # what a link hands to its parent: its inertia [[a, b], [b', d]] and bias force
        a: wp.types.matrix((3, 3), T)
        b: wp.types.matrix((3, 3), T)
        d: wp.types.matrix((3, 3), T)
        f: wp.types.vector(6, T)

    return SimpleNamespace(
        T=T,
        U=U,
        Load=Load,
        vec2=wp.types.vector(2, T),
        vec3=wp.types.vector(3, T),
        vec4=wp.types.vector(4, T),
        vec6=wp.types.vector(6, T),
        mat3=wp.types.matrix((3, 3), T),
        mat6=wp.types.matrix((6, 6), T),
        quat=wp.types.quaternion(T),
        Place=wp.types.vector(2, T) if "terrain" in spec.features else T,  # the carrier's: (x, z), or its height
        array=wp.array(dtype=T),
        array2=wp.array2d(dtype=U),  # a row for each environment
        array3=wp.array3d(dtype=T),  # checkpoints
        scene=scene_types(U),
        Model=scene_types(U).Model,
        Law=Law,
    )


def by_name(*functions: wp.Function) -> SimpleNamespace:
    """What a module of the kernels offers to others."""
    return SimpleNamespace(**{function.func.__name__: function for function in functions})


def model_of(scene: Scene, division: Division, dtype: type, device: str) -> Any:
    """The scene's numbers as a Warp struct on a device."""
    writer = _Writer(scene, division, dtype, device)
    writer.put_tree()
    writer.put_links()
    writer.put_motors_and_muscles()
    writer.put_contacts_and_bodies()
    return writer.model


class _Writer:
    """Fills a Model: of each lane's links a row of `slots` entries, of which the last ones may be of no use."""

    def __init__(self, scene: Scene, division: Division, dtype: type, device: str) -> None:
        self.scene, self.division, self.device = scene, division, device
        self.model_type = scene_types(dtype).Model
        self.model = self.model_type()
        threads, slots = division.threads_per_env, division.slots
        self.link = padded(division.links, slots)  # of each entry, and
        self.lane = np.repeat(np.arange(threads), slots)
        self.slot = np.zeros((threads, scene.nlink), np.int32)  # of each lane's each link
        for lane, row in enumerate(division.links):
            self.slot[lane, row] = np.arange(len(row))

    def put(self, **fields: Any) -> None:
        """Sets fields of the model, with the types that it declares."""
        for name, values in fields.items():
            kind = self.model_type.vars[name].type
            if isinstance(kind, wp.array):
                values = np.ascontiguousarray(values, np.int32 if kind.dtype is wp.int32 else float)
                # Warp gives an empty array no address; one unread element keeps the struct uniform.
                values = values if len(values) else np.zeros((1, *values.shape[1:]), values.dtype)
                setattr(self.model, name, wp.array(values, dtype=kind.dtype, device=self.device))
            else:
                setattr(self.model, name, kind(values))

    def put_tree(self) -> None:
        """Which links are whose, and where their frames are."""
        scene, link = self.scene, self.link
        skew = np.cross(np.eye(3)[None], scene.axis[:, None])  # skew(a) b = a x b
        hinge = np.where(scene.slide | (scene.ball >= 0), 0.0, 1.0)[:, None, None]
        r, square = scene.rotation, skew @ skew
        cos, sin = np.cos(scene.joint_ref)[:, None, None], np.sin(scene.joint_ref)[:, None, None]
        axis = np.einsum("nij,nj->ni", r, scene.axis)
        position = scene.position - np.where(scene.slide, scene.joint_ref, 0.0)[:, None] * axis
        self.put(
            count=[len(row) for row in self.division.links],
            link=link,
            parent=self.slot[self.lane, scene.parent[link]],
            qpos_adr=scene.qpos_adr[link],
            slide=scene.slide[link],
            # Rodrigues for the angle q - ref, expanded by the sum formulas: the kernels then need no reference.
            turn0=(r @ (np.eye(3) + hinge * square))[link],
            turn1=(hinge * (r @ (skew * cos - square * sin)))[link],
            turn2=(-hinge * (r @ (square * cos + skew * sin)))[link],
            position=position[link],
            axis=axis[link],
        )
        first, last = (np.arange(scene.nlink) + np.where(scene.ball < 0, 0, k - scene.ball) for k in (0, 2))
        balls = [np.flatnonzero(scene.ball[row] == 0).tolist() for row in self.division.links]
        self.put(
            ball_count=[len(row) for row in balls],
            ball_slot=padded(balls, scene.nball),
            inboard=self.slot[self.lane, scene.parent[first][link]],
            outboard=self.slot[self.lane, last[link]],
        )
        # Along the chain of slides that ends at the carrier nothing turns, so the offsets add up as they are.
        frame, place = np.eye(3), np.zeros(3)
        for i in range(1, scene.carrier + 1):
            place += frame @ position[i]
            frame = frame @ r[i]
        self.put(carrier_along=place[0], carrier_height=place[2] - scene.ground_height, gravity=scene.gravity)

    def put_links(self) -> None:
        """Each link's joint, and its inertia and drag, which one lane carries."""
        scene, link = self.scene, self.link
        weighs = self.division.weighs
        carried = np.array([i in weighs[lane] for lane, i in zip(self.lane, link, strict=True)], float)[:, None]
        frame, viscous, force, torque = scene.drag
        self.put(
            carried=carried[:, 0],
            **{name: getattr(scene, name)[link] * carried[:, 0] for name in ("mass", "lift", "base_damping")},
            inertia=scene.inertia[link] * carried[:, None],
            drag_frame=frame[link],
            drag_viscous=viscous[link] * carried,
            drag_force=force[link] * carried,
            drag_torque=torque[link] * carried,
        )
        names = "com lift_position armature damping stiffness spring_ref lower upper k_limit d_limit servo_stiffness"
        names += " servo_damping servo_ref force_low force_high"
        self.put(**{name: getattr(scene, name)[link] for name in names.split()})

    def put_motors_and_muscles(self) -> None:
        scene, muscles = self.scene, self.division.muscles
        motor_slot = self.slot[:, scene.motor_link]
        lane = (motor_slot > 0).argmax(0)  # of each motor and muscle
        for k, hand in enumerate(muscles):
            lane[hand] = k
        # Segments by lane, then by the pair of links that they join.
        key = np.column_stack([lane[scene.segment_muscle], scene.segment_link])
        order = np.lexsort(key.T[::-1])
        pairs, start = np.unique(key[order], axis=0, return_index=True)
        self.put(
            gear=scene.gear,
            motor_bias=scene.motor_bias,
            motor_slot=motor_slot.flatten(),
            motor_lane=lane,
            muscle_begin=np.cumsum([0, *map(len, muscles)]),
            muscle=sum(muscles, []),
            lane_begin=np.searchsorted(pairs[:, 0], np.arange(len(muscles) + 1)),
            pair_link=self.slot[pairs[:, :1], pairs[:, 1:]].flatten(),
            pair_begin=np.append(start, len(order)),
            segment_a=scene.segment_position[order, 0],
            segment_b=scene.segment_position[order, 1],
            segment_muscle=scene.segment_muscle[order],
        )

    def put_contacts_and_bodies(self) -> None:
        """Both by lane, then by slot: a body is on the lane that carries its link's mass; and the ground."""
        scene, d = self.scene, self.division
        begin, sphere = self.by_entry(d.spheres, scene.contact_link)
        self.put(
            contact_begin=begin,
            contact_position=scene.contact_position[sphere],
            contact_radius=scene.contact_radius[sphere],
            **{name: getattr(scene, name) for name in ("k_n", "k_d", "k_t", "mu")},
        )
        if scene.constraints is not None:
            self.put(
                contact_numbers=scene.constraints.contact[sphere],
                limit_numbers=scene.constraints.limit[self.link],
                joint_loss=scene.constraints.loss[self.link],
            )
        vertices = np.zeros((1, 1, 2)) if scene.terrain is None else scene.terrain
        along = np.diff(vertices, axis=1, append=vertices[:, -1:])
        along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), np.finfo(float).tiny)
        self.put(terrain=np.concatenate([vertices, along], 2))
        link = scene.body_link
        begin, body = self.by_entry([np.flatnonzero(np.isin(link, row)) for row in d.weighs], link)
        self.put(body_begin=begin, body=body, body_com=scene.body_com[body])

    def by_entry(self, hands: Sequence[Iterable[int]], link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where each entry begins, and the things themselves, of things on links that are dealt to the lanes."""
        rows = [
            (lane * self.division.slots + self.slot[lane, link[k]], k) for lane, hand in enumerate(hands) for k in hand
        ]
        entry, things = np.array(sorted(rows), int).reshape(-1, 2).T
        return np.searchsorted(entry, np.arange(len(self.link) + 1)), things


def padded(rows: list[list[int]], width: int) -> np.ndarray:
    """The rows end to end, each filled up with zeros."""
    return np.array([[*row, *[0] * (width - len(row))] for row in rows], np.int32).flatten()

"""Rows of MuJoCo's constraints between two bodies: equality and contact of a file, for kernels/pairs/rows.py."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from diffsim.robot import types
from diffsim.robot.contacts import UNBOUNDED, collide, declared_pairs, matrix_of, pair_law
from diffsim.robot.elements import at_rest, disabled_flags, label
from diffsim.robot.scene import Scene
from diffsim.robot.shapes import as_primitives, is_exact
from diffsim.robot.types import (
    BALL_BOX,
    BOXES,
    CAPSULE_BOX,
    CONTACTS,
    GEOMS,
    JOINT,
    PARALLEL,
    POINT,
    ROOM_OF_TREE,
    SEGMENTS,
    TURN,
    Array,
    Pairs,
    SceneError,
)

Row = Callable[[Array, Array, float, str], Array]  # solref, solimp, inverse weight and a name for messages
Touch = Callable[[int, int], Array]  # two geoms
_Geom = mujoco.mjtGeom
KINDS = {
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_CAPSULE): PARALLEL,  # SEGMENTS if they are not parallel, see first_poses
    (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_BOX): BALL_BOX,
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_BOX): CAPSULE_BOX,
    (_Geom.mjGEOM_BOX, _Geom.mjGEOM_BOX): BOXES,
}
STRAIGHT = 1e-4  # sine between two capsules that are parallel
Frame = tuple[int, Array, Array]  # a link (-1: the world beside a floating base), a point and a rotation in its frame
# The numbers of a block that its kind does not have
BLANK: dict[str, Any] = {"ref": np.zeros(2), "polycoef": np.zeros(5), "torquescale": 0.0, "size": np.zeros((2, 3))}
BLANK |= {"touch": SEGMENTS, "contacts": 0, "reach_sq": 0.0}


class _Rows:
    """Collects blocks of rows."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.m, self.data = scene, scene.mj_model, at_rest(scene.mj_model)
        shapes = as_primitives(self.m) if scene.geom_pairs else self.m
        self.shapes = shapes, at_rest(shapes)
        self.axes = [data.geom_xmat[:, 2::3] for data in first_poses(shapes)]  # z of each geom
        self.links = list[tuple[Array, Array]]()  # pose of each link at the reference configuration
        for k in range(scene.nlink):
            rotation, position = self.links[scene.parent[k]] if k else (np.eye(3), np.zeros(3))
            self.links.append((rotation @ scene.rotation[k], position + rotation @ scene.position[k]))
            if k == 0 and scene.floating:
                base = int(self.m.jnt_bodyid[0])
                self.links[0] = self.data.xmat[base].reshape(3, 3), self.data.xpos[base]
        self.blocks = list[Pairs]()

    def frame(self, body: int, position: Array, rotation: Array) -> Frame:
        """Return the link of a body, and a pose at the reference configuration in the frame of that link."""
        link = int(self.scene.body_link[body])
        turn, origin = self.links[link] if link >= 0 else (np.eye(3), np.zeros(3))
        return link, turn.T @ (position - origin), turn.T @ rotation

    def add(self, kind: int, ends: Sequence[Frame], params: Array, partner: int = 0, **numbers: Any) -> None:
        """Append a block; partner is the distance of the other block of its constraint."""
        links, points, frames = zip(*ends, strict=True)
        block = BLANK | {"kind": kind, "partner": len(self.blocks) + partner, "params": params}
        block |= {"link": links, "point": points, "frame": frames}
        self.blocks.append(Pairs(**block | numbers))

    def pairs(self) -> Pairs | None:
        if not self.blocks:
            return None
        heads = Pairs._make(np.array(values) for values in zip(*self.blocks, strict=True))
        further = np.maximum(heads.contacts - 1, 0)  # contacts, which come at the end
        number, order = len(further), np.r_[np.arange(len(further)), np.repeat(np.arange(len(further)), further)]
        heads.partner[further > 0] = number + (further.cumsum() - further)[further > 0]
        pairs = Pairs._make(values[order] for values in heads)
        pairs.partner[number:], pairs.contacts[number:] = np.arange(number, len(order)), 0
        return pairs

    def add_geoms(self, a: int, b: int, params: Array) -> None:
        """Append the block of two geoms."""
        m, data = self.shapes
        geoms = sorted((a, b), key=lambda geom: int(m.geom_type[geom]))  # MuJoCo's order: a sphere comes first
        turns, (first, second) = data.geom_xmat[geoms].reshape(2, 3, 3), (_Geom(kind) for kind in m.geom_type[geoms])
        ends = list(map(self.frame, m.geom_bodyid[geoms].tolist(), data.geom_xpos[geoms], turns))
        touch = KINDS.get((first, second), SEGMENTS)
        if touch == PARALLEL and min(np.linalg.norm(np.cross(*z[geoms])) for z in self.axes) > STRAIGHT:
            touch = SEGMENTS
        size = np.where(m.geom_type[geoms, None] == _Geom.mjGEOM_SPHERE, [1, 0, 0], 1) * m.geom_size[geoms]
        reach = max(params[10] + m.geom_rbound[geoms].sum(), 0.0)
        self.add(GEOMS, ends, params, size=size, touch=touch, contacts=CONTACTS[touch], reach_sq=reach**2)

    def add_equality(self, k: int, row: Row) -> None:
        """Append the blocks of the file's equality constraint k."""
        m, kind = self.m, self.m.eq_type[k]
        one, two, data = int(m.eq_obj1id[k]), int(m.eq_obj2id[k]), m.eq_data[k]

        def params(weight: float) -> Array:
            name = f"equality {label(m, mujoco.mjtObj.mjOBJ_EQUALITY, k)}"
            return row(m.eq_solref[k], m.eq_solimp[k], float(weight), name)

        if kind == mujoco.mjtEq.mjEQ_JOINT:
            joints = [one] + [two] * (two >= 0)
            dofs = m.jnt_dofadr[joints]
            ends = [(int(dof) - m.nv + self.scene.nlink, np.zeros(3), np.eye(3)) for dof in dofs.tolist()]
            refs, coef = m.qpos0[m.jnt_qposadr[joints]].tolist(), data[:5]
            if two < 0:
                ends, refs = [*ends, (-1 * self.scene.floating, *ends[0][1:])], [*refs, 0.0]
                coef = coef * [1, 0, 0, 0, 0]
            self.add(JOINT, ends[::-1], params(m.dof_invweight0[dofs].sum()), ref=refs[::-1], polycoef=coef)
            return
        bodies, places, turns = self.ends(k)
        weight = m.body_invweight0[bodies].sum(0)
        frames = list(map(self.frame, bodies, places, turns))[::-1]
        welded = kind == mujoco.mjtEq.mjEQ_WELD
        self.add(POINT, frames, params(weight[0]), int(welded))
        if welded:
            self.add(TURN, frames, params(weight[1]), -1, torquescale=data[10])

    def ends(self, k: int) -> tuple[list[int], list[Array], list[Array]]:
        """Return the bodies of a connect or weld, and the points and orientations that it compares."""
        m, data, numbers = self.m, self.data, self.m.eq_data[k]
        objects = [int(m.eq_obj1id[k]), int(m.eq_obj2id[k])]
        if m.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
            turns = [data.site_xmat[site].reshape(3, 3) for site in objects]
            return m.site_bodyid[objects].tolist(), list(data.site_xpos[objects]), turns
        welded = m.eq_type[k] == mujoco.mjtEq.mjEQ_WELD
        anchors = (numbers[3:6], numbers[:3]) if welded else (numbers[:3], numbers[3:6])
        turns = [data.xmat[body].reshape(3, 3) for body in objects]
        places = [data.xpos[b] + turn @ anchor for b, turn, anchor in zip(objects, turns, anchors, strict=True)]
        if welded:
            turns[0] = turns[0] @ matrix_of(numbers[6:10])
        return objects, places, turns


def self_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """List the pairs of geoms, without the ground, that may touch each other: MuJoCo's filters."""
    weld, found = m.body_weldid[m.geom_bodyid], list[tuple[int, int]]()
    parent = m.body_weldid[m.body_parentid[weld]]
    filters = "filterparent" not in disabled_flags(m)
    parts = np.flatnonzero((weld > 0) | ~np.isin(m.geom_type, UNBOUNDED))
    declared = [pair for pair in declared_pairs(m) if np.isin(pair, parts).all()]
    for k, a in enumerate(parts.tolist()):
        b = parts[k + 1 :]
        related = ((parent[a] == weld[b]) | (parent[b] == weld[a])) & (weld[a] > 0) & (weld[b] > 0)
        touch = (weld[a] != weld[b]) & ~(filters & related) & collide(m, a, b)
        touch |= np.isin(b, [second for first, second in declared if first == a])
        found += [(a, other) for other in b[touch].tolist()]
    return found


def default_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """List the pairs that touch without with_pairs, see load_scene."""
    pairs, body = np.array(self_pairs(m), int).reshape(-1, 2), m.geom_bodyid
    tree, root = m.body_treeid[body[pairs]], m.body_rootid[body[pairs]]
    own = (tree[:, 0] == tree[:, 1]) | ((tree.min(1) < 0) & (root[:, 0] == root[:, 1]))  # or of the tree's fixed base
    free = m.ntree > 1 and (m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
    return [(a, b) for a, b in pairs[free | ~own].tolist()]


def with_pairs(scene: Scene) -> Scene:
    """Return a copy in which a robot's own parts touch each other, too, as the file lets them, on MuJoCo's contact.

    Example:
        from diffsim.robot.pairs import with_pairs
        scene = with_pairs(diffsim.load_scene("robot.xml"))  # for Simulator, or to return from Task.load_robot

    Capsules and boxes stand for other shapes, see `as_primitives`. A pair is left out that so overlaps in the first
    keyframe, or the reference pose, though the file's shapes do not.

    Raises:
        SceneError: the numbers of a pair are not simulated.
    """
    return _with(scene, self_pairs(scene.mj_model))


def with_defaults(scene: Scene) -> Scene:
    """Return a copy whose pairs are the default ones; itself without any."""
    pairs = default_pairs(scene.mj_model)
    return _with(scene, pairs) if pairs else scene


def _with(scene: Scene, candidates: list[tuple[int, int]]) -> Scene:
    m, pairs = scene.mj_model, list[tuple[int, int]]()
    declarations, overlapping = declared_pairs(m), touching_pairs(as_primitives(m)) - touching_pairs(m)
    for a, b in candidates:
        declared, solref = declarations.get((a, b)), pair_law(m, a, b).solref
        if (solref[0] > 0) != (solref[1] > 0) or (declared is not None and np.ptp(m.pair_friction[declared, :2])):
            names = " and ".join(label(m, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in (a, b))
            raise SceneError(f"{scene.name}: geoms {names}: solref of two signs, or friction that differs by direction")
        overlaps = (a, b) in overlapping and not is_exact(m, a, b)
        if not overlaps and not {m.geom_type[a], m.geom_type[b]} & set(UNBOUNDED):
            pairs.append((a, b))
    return dataclasses.replace(scene, geom_pairs=tuple(pairs))


def first_poses(m: mujoco.MjModel) -> Iterator[mujoco.MjData]:
    """Compute MuJoCo's kinematics of the reference pose and of each keyframe."""
    for key in range(-1, m.nkey):
        data = mujoco.MjData(m)
        if key >= 0:
            mujoco.mj_resetDataKeyframe(m, data, key)
        mujoco.mj_kinematics(m, data)
        yield data


def touching_pairs(m: mujoco.MjModel) -> set[tuple[int, int]]:
    """Return the pairs of geoms that touch in the first keyframe, or in the reference pose."""
    data = mujoco.MjData(m)
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, data, 0)
    mujoco.mj_fwdPosition(m, data)
    return touching(data)


def touching(data: mujoco.MjData) -> set[tuple[int, int]]:
    """Return the pairs of geoms of MuJoCo's contacts, the lower one first."""
    return {(min(a, b), max(a, b)) for a, b in data.contact.geom.tolist()}


def first_contacts(scene: Scene) -> int:
    """Count the contacts of pairs in the reference pose or the keyframe that has most of them."""
    pairs, most = set(scene.geom_pairs), 0
    for data in first_poses(as_primitives(scene.mj_model)) if pairs else ():
        mujoco.mj_collision(data.model, data)
        most = max(most, sum((min(a, b), max(a, b)) in pairs for a, b in data.contact.geom.tolist()))
    return most


def room_of(scene: Scene) -> int:
    """Return the room for contacts of pairs at once: more for many bodies, or if there are many at first."""
    wanted = max(ROOM_OF_TREE * scene.mj_model.ntree, 2 * first_contacts(scene))
    return min(max(types.LEAST_ROOM, wanted), types.MOST_ROOM)


def rows_of(scene: Scene, row: Row, touch: Touch) -> Pairs | None:
    """Collect the rows between bodies of a scene; `row` and `touch` make rows of constants."""
    rows = _Rows(scene)
    for k in np.flatnonzero(scene.mj_model.eq_active0).tolist():
        rows.add_equality(k, row)
    for a, b in scene.geom_pairs:
        rows.add_geoms(a, b, touch(a, b))
    return rows.pairs()

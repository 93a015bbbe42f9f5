"""Rows of MuJoCo's constraints between two bodies: equality and contact of a file, for kernels/pairs/rows.py."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.contact import UNBOUNDED, base_geoms, collide, declared_pairs, hull, matrix_of, pair_law
from diffsim.robot.elements import at_rest, disabled_flags, label
from diffsim.robot.scene import Array, Index, Scene, SceneError

Row = Callable[[Array, Array, float, str], Array]  # solref, solimp, inverse weight and a name for messages
Touch = Callable[[int, int], Array]  # two geoms
JOINT, POINT, TURN, GEOMS = range(4)  # kinds of blocks, see kernels/pairs/rows.py
NAMES = "joint", "point", "turn", "geoms"
_Geom = mujoco.mjtGeom
SHAPES = [int(getattr(_Geom, f"mjGEOM_{name}")) for name in ("ELLIPSOID", "CYLINDER", "MESH")]  # made others
# Kinds of two geoms: parallel capsules, spheres and capsules, a sphere and a box, a capsule and a box, two boxes
PARALLEL, SEGMENTS, BALL_BOX, CAPSULE_BOX, BOXES = range(-1, 4)
CONTACTS = {PARALLEL: 2, SEGMENTS: 1, BALL_BOX: 1, CAPSULE_BOX: 2, BOXES: 8}  # at most, of a pair
KINDS = {
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_CAPSULE): PARALLEL,  # SEGMENTS if they are not parallel
    (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_BOX): BALL_BOX,
    (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_BOX): CAPSULE_BOX,
    (_Geom.mjGEOM_BOX, _Geom.mjGEOM_BOX): BOXES,
}
FEATURES = {PARALLEL: "parallel_geoms", CAPSULE_BOX: "capsule_box_geoms", BOXES: "box_geoms"}
STRAIGHT = 1e-4  # sine between two capsules that are parallel
DIRECTIONS = 2000  # in which shapes are measured
ROUND = 0.8  # thickness over width from which on a capsule may stand for a shape
MOST_PAIRS = 64  # contacts at once, in the environments that a thread steps together
Frame = tuple[int, Array, Array]  # a link (-1: the world beside a floating base), a point and a rotation in its frame


class PairSizes(NamedTuple):
    """Sizes that the kernels' code depends on."""

    equalities: int = 0  # number of blocks of equality, which come first
    heads: int = 0  # number of these and of the first ones of two geoms, which come next
    most: int = 1  # contacts of two geoms, at most
    points: int = 0  # number of points of blocks
    blocks: int = 0  # number of blocks in local arrays, of which the last ones are room for those of two geoms

    @property
    def last(self) -> int:
        """Return the first element of that room."""
        return self.blocks - self.most


class Pairs(NamedTuple):
    """Blocks of three rows between two bodies; point and frame of each are in the frame of the body's link."""

    kind: Index  # (n,)
    link: Index  # (n, 2) first and second link, -1 for the world beside a floating base
    partner: Index  # (n,) the other block of a weld, the second one of two geoms, or itself
    params: Array  # (n, 11) as Constraints.contact
    # (n, 11) of a joint: q_0 of the second and of the first, five coefficients; of a turn: its scale; of two geoms: the
    # square of the distance where they may touch, radii, half axes in their links' frames or a box's half lengths,
    # their kind, and how many contacts they may have, or 0 in all blocks but the first
    shape: Array
    first: Array  # (n, 3) m
    second: Array  # (n, 3) m
    first_frame: Array  # (n, 3, 3)
    second_frame: Array  # (n, 3, 3)

    @property
    def features(self) -> frozenset[str]:
        """Return the names of the kinds that are there, for Scene.features."""
        kinds = set(self.shape[self.kind == GEOMS, 9].tolist())
        rows = frozenset(f"{NAMES[kind]}_rows" for kind in self.kind.tolist())
        return rows | {name for kind, name in FEATURES.items() if kind in kinds}

    @property
    def geom_pairs(self) -> NDArray[np.int64]:
        """Return which pair of geoms each block is of that belongs to one."""
        contacts = self.shape[self.kind == GEOMS, 10].astype(int)
        heads = np.arange(len(contacts[contacts > 0]))
        return np.r_[heads, heads.repeat(contacts[contacts > 0] - 1)]

    @property
    def points(self) -> tuple[Array, NDArray[np.int64]]:
        """Return each point once, its link before its coordinates (m, 4), and which ones are a block's (n, 2)."""
        all_of = np.concatenate((self.link[..., None], np.stack((self.first, self.second), 1)), 2)
        points, which = np.unique(all_of.reshape(-1, 4), axis=0, return_inverse=True)
        return points, which.reshape(-1, 2)

    @property
    def sizes(self) -> PairSizes:
        """Return sizes of the kernels' arrays."""
        equalities, number = int((self.kind != GEOMS).sum()), len(self.kind)
        contacts = self.shape[equalities:, 10]
        heads, most = equalities + int((contacts > 0).sum()), int(contacts.max(initial=1))
        return PairSizes(equalities, heads, most, len(self.points[0]), min(number, equalities + MOST_PAIRS) + most)


class _Rows:
    """Collects blocks of rows."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.m, self.data = scene, scene.mj_model, at_rest(scene.mj_model)
        shapes = as_primitives(self.m) if scene.geom_pairs else self.m
        self.shapes = shapes, at_rest(shapes)
        self.links = list[tuple[Array, Array]]()  # pose of each link at the reference configuration
        for k in range(scene.nlink):
            rotation, position = self.links[scene.parent[k]] if k else (np.eye(3), np.zeros(3))
            self.links.append((rotation @ scene.rotation[k], position + rotation @ scene.position[k]))
            if k == 0 and scene.floating:
                base = int(self.m.jnt_bodyid[0])
                self.links[0] = self.data.xmat[base].reshape(3, 3), self.data.xpos[base]
        self.blocks = list[tuple[int, tuple[Frame, Frame], int, Array, Array]]()

    def frame(self, body: int, position: Array, rotation: Array) -> Frame:
        """Return the link of a body, and a pose at the reference configuration in the frame of that link."""
        link = int(self.scene.body_link[body])
        turn, origin = self.links[link] if link >= 0 else (np.eye(3), np.zeros(3))
        return link, turn.T @ (position - origin), turn.T @ rotation

    def add(
        self, kind: int, first: Frame, second: Frame, params: Array, partner: int = 0, shape: ArrayLike = ()
    ) -> None:
        """Append a block; partner is the distance of the other block of its constraint."""
        numbers = np.concatenate((np.ravel(shape), np.zeros(11)))[:11]
        self.blocks.append((kind, (first, second), len(self.blocks) + partner, params, numbers))

    def pairs(self) -> Pairs | None:
        if not self.blocks:
            return None
        kind, ends, partner, params, shape = zip(*self.blocks, strict=True)
        links, points, frames = (
            [np.array([each[side][part] for each in ends]) for side in (0, 1)] for part in range(3)
        )
        link = np.stack(links, 1).astype(np.int32)
        kinds, partners = (np.array(each, np.int32) for each in (kind, partner))
        heads = Pairs(kinds, link, partners, np.array(params), np.array(shape), *points, *frames)
        further = np.where(kinds == GEOMS, heads.shape[:, 10] - 1, 0).astype(int)  # contacts, which come at the end
        number, order = len(kinds), np.r_[np.arange(len(kinds)), np.repeat(np.arange(len(kinds)), further)]
        partners[further > 0] = number + (further.cumsum() - further)[further > 0]
        pairs = Pairs._make(values[order] for values in heads)
        pairs.partner[number:], pairs.shape[number:, 10] = np.arange(number, len(order)), 0
        return pairs

    def add_geoms(self, a: int, b: int, params: Array) -> None:
        """Append the block of two geoms."""
        (m, data), reach = self.shapes, params[10]
        geoms = sorted((a, b), key=lambda geom: int(m.geom_type[geom]))  # MuJoCo's order: a sphere comes first
        ends, sizes, radii = list[Frame](), list[Array](), list[float]()
        for geom in geoms:
            kind, size, turn = m.geom_type[geom], m.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
            end, boxed = self.frame(m.geom_bodyid[geom], data.geom_xpos[geom], turn), kind == _Geom.mjGEOM_BOX
            ends.append(end)
            radii.append(0.0 if boxed else size[0])
            sizes.append(size if boxed else size[1] * (kind == _Geom.mjGEOM_CAPSULE) * end[2][:, 2])
            reach += m.geom_rbound[geom]
        first, second = (_Geom(int(m.geom_type[geom])) for geom in geoms)
        touch = KINDS.get((first, second), SEGMENTS)
        one, other = data.geom_xmat[geoms, 2::3]  # their z axes
        if touch == PARALLEL and np.linalg.norm(np.cross(one, other)) > STRAIGHT:
            touch = SEGMENTS
        shape = max(reach, 0.0) ** 2, *radii, *sizes[0], *sizes[1], touch, CONTACTS[touch]
        self.add(GEOMS, ends[0], ends[1], params, 0, shape)

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
            refs = m.qpos0[m.jnt_qposadr[joints]].tolist()
            if two < 0:
                ends, refs, data = [*ends, (-1 * self.scene.floating, *ends[0][1:])], [*refs, 0.0], data[:1]
            self.add(JOINT, ends[1], ends[0], params(m.dof_invweight0[dofs].sum()), 0, [*refs, *data[:5]])
            return
        bodies, places, turns = self.ends(k)
        weight = m.body_invweight0[bodies].sum(0)
        first, second = (self.frame(*each) for each in list(zip(bodies, places, turns, strict=True))[::-1])
        welded = kind == mujoco.mjtEq.mjEQ_WELD
        self.add(POINT, first, second, params(weight[0]), int(welded))
        if welded:
            self.add(TURN, first, second, params(weight[1]), -1, [data[10]])

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


def obstacle_geoms(m: mujoco.MjModel) -> NDArray[np.bool_]:
    """Mark fixed geoms (ngeom,) of bounded shapes that are no part of the robot's base, such as a step of stairs."""
    return (m.body_weldid[m.geom_bodyid] == 0) & ~base_geoms(m) & ~np.isin(m.geom_type, UNBOUNDED)


def obstacle_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """List the pairs with such a geom."""
    fixed = obstacle_geoms(m)
    return [pair for pair in self_pairs(m) if fixed[list(pair)].any()]


def is_exact(m: mujoco.MjModel, a: int, b: int) -> bool:
    """Tell whether two geoms touch each other in their own shapes."""
    return not np.isin(m.geom_type[[a, b]], SHAPES).any()


def as_primitives(m: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy whose geoms have the shapes that touch each other here: a capsule or a box in place of SHAPES.

    A capsule has the length of its geom's bounding box, and its mean width. The bounding box itself stands for an
    obstacle that is not about as thick as wide, such as a plate or a disc, on which a robot may step, or if its surface
    is clearly nearer to the shape's: pairs with a box cost more.
    """
    fitted, fixed = copy.copy(m), obstacle_geoms(m)
    for geom in np.flatnonzero(np.isin(m.geom_type, SHAPES)).tolist():
        _fit(m, fitted, geom, boxed=False)
        if fixed[geom]:
            difference, (thick, wide, _) = deviation(m, fitted, geom), np.sort(m.geom_aabb[geom, 3:])
            _fit(m, fitted, geom, boxed=True)
            if thick > ROUND * wide and deviation(m, fitted, geom) > 0.95 * difference:
                _fit(m, fitted, geom, boxed=False)
    return fitted


def _fit(m: mujoco.MjModel, fitted: mujoco.MjModel, geom: int, boxed: bool) -> None:
    """Give a geom of the other model its bounding box or a capsule, or a sphere if that box is a cube."""
    (centre, half), turn = np.split(m.geom_aabb[geom], 2), np.zeros(4)
    kind, size, bound, along = _Geom.mjGEOM_BOX, half, np.linalg.norm(half), 2
    if not boxed:
        along = int(half.argmax())
        radius, bound = np.delete(half, along).mean(), half[along]
        kind = _Geom.mjGEOM_CAPSULE if bound > radius else _Geom.mjGEOM_SPHERE
        size, half = np.array([radius, bound - radius, 0.0]), np.array([radius, radius, bound])
    mujoco.mju_quatZ2Vec(turn, np.eye(3)[along])
    mujoco.mju_mulPose(fitted.geom_pos[geom], fitted.geom_quat[geom], m.geom_pos[geom], m.geom_quat[geom], centre, turn)
    fitted.geom_type[geom], fitted.geom_size[geom], fitted.geom_rbound[geom] = kind, size, bound
    fitted.geom_aabb[geom], fitted.geom_sameframe[geom] = [0.0, 0.0, 0.0, *half], 0


def deviation(m: mujoco.MjModel, other: mujoco.MjModel, geom: int) -> float:
    """Return the largest distance [m] between the surfaces of a geom's convex hulls in two models."""
    return float(abs(reach(m, geom) - reach(other, geom)).max())


def directions() -> Array:
    """Return unit vectors (DIRECTIONS, 3) that are spread evenly."""
    turn, z = np.pi * (3 - 5**0.5) * np.arange(DIRECTIONS), 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    level = np.sqrt(1 - z**2)
    return np.stack((level * np.cos(turn), level * np.sin(turn), z), 1)


def reach(m: mujoco.MjModel, geom: int) -> Array:
    """Return how far [m] a shape reaches in each direction (DIRECTIONS,) from the origin of its body's frame."""
    (a, b, c), kind = m.geom_size[geom], m.geom_type[geom]
    along = directions() @ matrix_of(m.geom_quat[geom])
    x, y, z = abs(along.T)
    reaches = {
        int(_Geom.mjGEOM_SPHERE): a + 0 * z,
        int(_Geom.mjGEOM_CAPSULE): a + b * z,
        int(_Geom.mjGEOM_CYLINDER): a * np.hypot(x, y) + b * z,
        int(_Geom.mjGEOM_BOX): a * x + b * y + c * z,
        int(_Geom.mjGEOM_ELLIPSOID): np.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2),
    }
    corners = hull(m, m.geom_dataid[geom]) if kind == _Geom.mjGEOM_MESH else np.zeros((1, 3))
    return reaches.get(int(kind), (along @ corners.T).max(1)) + directions() @ m.geom_pos[geom]


def with_pairs(scene: Scene) -> Scene:
    """Return a copy whose parts touch each other and fixed geoms as the file lets them, on MuJoCo's contact.

    Example:
        from diffsim.robot.pairs import with_pairs
        scene = with_pairs(diffsim.load_scene("robot.xml"))  # for Simulator, or to return from Task.load_robot

    Capsules and boxes stand for other shapes, see `as_primitives`. A pair is left out that so overlaps in the first
    keyframe, or the reference pose, though the file's shapes do not.

    Raises:
        SceneError: the numbers of a pair are not simulated.
    """
    return _with(scene, self_pairs(scene.mj_model))


def with_obstacles(scene: Scene) -> Scene:
    """Return a copy whose parts touch fixed geoms beside the ground, and not each other; itself without such geoms."""
    pairs = obstacle_pairs(scene.mj_model)
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


def rows_of(scene: Scene, row: Row, touch: Touch) -> Pairs | None:
    """Collect the rows between bodies of a scene; `row` and `touch` make rows of constants."""
    rows = _Rows(scene)
    for k in np.flatnonzero(scene.mj_model.eq_active0).tolist():
        rows.add_equality(k, row)
    for a, b in scene.geom_pairs:
        rows.add_geoms(a, b, touch(a, b))
    return rows.pairs()

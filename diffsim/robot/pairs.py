"""Rows of MuJoCo's constraints between two bodies: equality and contact of a file, for kernels/pairs.py."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from diffsim.robot.contact import base_geoms, collide, declared_pairs, pair_law
from diffsim.robot.elements import at_rest, disabled_flags, label
from diffsim.robot.scene import Array, Index, Scene, SceneError

Row = Callable[[Array, Array, float, str], Array]  # solref, solimp, inverse weight and a name for messages
Touch = Callable[[int, int], Array]  # two geoms
JOINT, POINT, TURN, GEOMS = range(4)  # kinds of blocks, see kernels/pairs.py
NAMES = "joint", "point", "turn", "geoms"
SHAPES = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE  # of geoms that may touch each other
Frame = tuple[int, Array, Array]  # a link (-1: the world beside a floating base), a point and a rotation in its frame


class Pairs(NamedTuple):
    """Blocks of three rows between two bodies; point and frame of each are in the frame of the body's link."""

    kind: Index  # (n,)
    link: Index  # (n, 2) first and second link, -1 for the world beside a floating base
    partner: Index  # (n,) the other block of a weld, or itself
    params: Array  # (n, 11) as Constraints.contact
    # (n, 11) of a joint: q_0 of the second and of the first, five coefficients; of a turn: its scale; of two geoms: the
    # square of the distance where they may touch, radii, and half axes in their links' frames
    shape: Array
    first: Array  # (n, 3) m
    second: Array  # (n, 3) m
    first_frame: Array  # (n, 3, 3)
    second_frame: Array  # (n, 3, 3)

    @property
    def features(self) -> frozenset[str]:
        """Return the names of the kinds that are there, for Scene.features."""
        return frozenset(f"{NAMES[kind]}_rows" for kind in self.kind.tolist())

    @property
    def geoms(self) -> int:
        """Return the number of blocks of two geoms, which are the last ones."""
        return int((self.kind == GEOMS).sum())


class _Rows:
    """Collects blocks of rows."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.m, self.data = scene, scene.mj_model, at_rest(scene.mj_model)
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
        return Pairs(kinds, link, partners, np.array(params), np.array(shape), *points, *frames)

    def add_geoms(self, a: int, b: int, params: Array) -> None:
        """Append the block of two geoms."""
        m, ends, axes, reach = self.m, list[Frame](), list[Array](), params[10]
        geoms = sorted((a, b), key=lambda geom: int(m.geom_type[geom]))  # MuJoCo's order: a sphere before a capsule
        for geom in geoms:
            end = self.frame(m.geom_bodyid[geom], self.data.geom_xpos[geom], self.data.geom_xmat[geom].reshape(3, 3))
            half = m.geom_size[geom, 1] * (m.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE)
            ends.append(end)
            axes.append(half * end[2][:, 2])
            reach += m.geom_rbound[geom]
        shape = max(reach, 0.0) ** 2, *m.geom_size[geoms, 0], *np.concatenate(axes)
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
            relative = np.zeros(9)
            mujoco.mju_quat2Mat(relative, numbers[6:10])
            turns[0] = turns[0] @ relative.reshape(3, 3)
        return objects, places, turns


def self_pairs(m: mujoco.MjModel) -> list[tuple[int, int]]:
    """List the pairs of the robot's geoms that may touch each other: MuJoCo's filters."""
    weld, found = m.body_weldid[m.geom_bodyid], list[tuple[int, int]]()
    parent = m.body_weldid[m.body_parentid[weld]]
    filters = "filterparent" not in disabled_flags(m)
    parts = np.flatnonzero((weld > 0) | base_geoms(m))
    declared = [pair for pair in declared_pairs(m) if np.isin(pair, parts).all()]
    for k, a in enumerate(parts.tolist()):
        b = parts[k + 1 :]
        related = ((parent[a] == weld[b]) | (parent[b] == weld[a])) & (weld[a] > 0) & (weld[b] > 0)
        touch = (weld[a] != weld[b]) & ~(filters & related) & collide(m, a, b)
        touch |= np.isin(b, [second for first, second in declared if first == a])
        found += [(a, other) for other in b[touch].tolist()]
    return found


def with_pairs(scene: Scene) -> Scene:
    """Return a copy whose parts touch each other as the file lets them, where they are spheres and capsules.

    It needs MuJoCo's contact.

    Raises:
        SceneError: the numbers of a pair are not simulated.
    """
    m, label_of = scene.mj_model, lambda geom: label(scene.mj_model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    pairs = [pair for pair in self_pairs(m) if np.isin(m.geom_type[[*pair]], SHAPES).all()]
    for pair in pairs:
        declared = declared_pairs(m).get(pair)
        solref = pair_law(m, *pair).solref
        if (solref[0] > 0) != (solref[1] > 0):
            raise SceneError(f"{scene.name}: geoms {' and '.join(map(label_of, pair))}: solref mixes signs")
        if declared is not None and m.pair_friction[declared, 0] != m.pair_friction[declared, 1]:
            raise SceneError(f"{scene.name}: geoms {' and '.join(map(label_of, pair))}: friction differs by direction")
    return dataclasses.replace(scene, geom_pairs=tuple(pairs))


def rows_of(scene: Scene, row: Row, touch: Touch) -> Pairs | None:
    """Collect the rows between bodies of a scene; `row` and `touch` make rows of constants."""
    rows = _Rows(scene)
    for k in np.flatnonzero(scene.mj_model.eq_active0).tolist():
        rows.add_equality(k, row)
    for a, b in scene.geom_pairs:
        rows.add_geoms(a, b, touch(a, b))
    return rows.pairs()

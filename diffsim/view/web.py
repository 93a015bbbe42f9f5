"""A motion as one web page, which plays in any browser without network access; the page itself is assets/web.html."""

from __future__ import annotations

import base64
import html
import json
import os
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.scene import Scene
from diffsim.view.render import GHOST, activations, orbit, whole_file

MAX_BYTES = 700_000  # of poses; a longer motion keeps every second control step, or fewer
MESH_BYTES = 1_500_000  # of meshes; vertices of finer ones are merged
HIDDEN_GROUP = 3  # geoms from this group on are not drawn, as in MuJoCo
MESHES = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD)
Array = NDArray[Any]


def write_page(
    path: str | os.PathLike[str],
    scene: Scene,
    qpos: ArrayLike,
    control_dt: float,
    ctrl: ArrayLike | None = None,
    title: str = "",
    caption: str = "",
    ghost: ArrayLike | None = None,
) -> Path:
    """Write a page that plays qpos (T, nq), with muscles coloured by ctrl (T, nu) in [-1, 1], and a transparent ghost
    (T or more, nq); returns the file.

    A row is a control step of control_dt [s]; the path ends in .html. The page says title and caption, which may have
    several lines. Muscles are drawn straight from point to point, terrain as the first environment has it.

    Raises:
        ValueError: another suffix.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(f"a page ends in .html, not {path.suffix!r}")
    page = fill_page(describe(scene, qpos, control_dt, ctrl, ghost), title, caption)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def fill_page(motion: dict[str, Any], title: str, caption: str) -> str:
    """The page that shows what `describe` found."""
    page = (files("diffsim") / "assets" / "web.html").read_text(encoding="utf-8")
    parts = {"title": html.escape(title), "caption": html.escape(caption)}
    parts["motion"] = json.dumps(motion).replace("<", "\\u003c")
    return re.sub(r"\$(title|caption|motion)\b", lambda name: parts[name[1]], page)


def describe(
    scene: Scene, qpos: ArrayLike, control_dt: float, ctrl: ArrayLike | None = None, ghost: ArrayLike | None = None
) -> dict[str, Any]:
    """What the page draws: shapes once, and of every frame the pose of each body and the activation of each muscle."""
    model, qpos = scene.mj_model, np.asarray(qpos, dtype=np.float64)
    shown = [qpos] if ghost is None else [qpos, np.asarray(ghost, dtype=np.float64)[: len(qpos)]]
    bodies = len(shown) * model.nbody
    stride = 1 + len(qpos) * bodies * 28 // MAX_BYTES
    relaxed = np.full((len(qpos), model.nu), -1.0)
    ctrl = (relaxed if ctrl is None else np.asarray(ctrl))[::stride]
    planes, painted = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, model.geom_matid >= 0
    rgba = model.geom_rgba.copy()
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    geoms, surfaces = [], dict[tuple[bool, int], tuple[Array, Array]]()  # height fields and meshes have own numbers
    for k in np.flatnonzero(~planes & (model.geom_group < HIDDEN_GROUP) & (rgba[:, 3] > 0)).tolist():
        kind, data = mujoco.mjtGeom(model.geom_type[k]), int(model.geom_dataid[k])
        numbers = {"size": model.geom_size, "pos": model.geom_pos, "quat": model.geom_quat, "rgba": rgba}
        geom = {"body": int(model.geom_bodyid[k])} | {name: _rounded(values[k]) for name, values in numbers.items()}
        if kind in MESHES:
            key = kind == mujoco.mjtGeom.mjGEOM_HFIELD, data
            surfaces.setdefault(key, _surface(model, *key))
            geoms.append(geom | {"type": "mesh", "mesh": [*surfaces].index(key)})
        else:
            geoms.append(geom | {"type": kind.name.removeprefix("mjGEOM_").lower()})
    if ghost is not None:
        moving, colour = [geom for geom in geoms if geom["body"]], {"rgba": _rounded(GHOST)}
        geoms += [geom | colour | {"body": geom["body"] + model.nbody} for geom in moving]
    ground = None
    if scene.terrain is not None:
        ground = [_rounded(vertex) for vertex in scene.terrain[0]]
    elif planes.any():
        ground = [[x, float(model.geom_pos[planes][0, 2])] for x in (0.0, 1.0)]
    return {
        "dt": stride * control_dt,
        "frames": len(ctrl),
        "bodies": bodies,
        "robot": model.nbody,  # bodies, before those of the ghost
        "ground": ground,  # a profile (K, 2) of x and z, whose first and last segment go on for ever
        "geoms": geoms,
        "meshes": _meshes([*surfaces.values()]),
        "muscles": [_muscle(model, tendon) for tendon in activations(model, ctrl)[0]],
        "camera": orbit(model),
        **encode(model, *poses(model, *(each[::stride] for each in shown)), ctrl),
    }


def encode(model: mujoco.MjModel, poses: Array, track: Array, ctrl: Array) -> dict[str, str]:
    """What moves, with what `poses` found and ctrl (T, nu): numbers in the page's order, as base64."""
    activation = activations(model, ctrl)[1]
    return {
        "poses": _base64(poses.astype("<f4")),
        "track": _base64(track.astype("<f4")),
        "activation": _base64((activation * 255).round().astype(np.uint8)),
    }


def poses(model: mujoco.MjModel, qpos: Array, ghost: Array | None = None) -> tuple[Array, Array]:
    """(T, nbody, 7) position and quaternion wxyz of each body, and (T, 3) what the camera follows.

    That is the centre of mass of the body that carries the camera, at its mean height, so that the picture keeps still.
    The bodies of a ghost follow the robot's.
    """
    data, carrier = mujoco.MjData(model), model.cam_bodyid[0] if model.ncam else min(1, model.nbody - 1)
    places, track = np.empty((len(qpos), model.nbody, 7)), np.empty((len(qpos), 3))
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        places[t, :, :3], places[t, :, 3:], track[t] = data.xpos, data.xquat, data.subtree_com[carrier]
    track[:, 2] = track[:, 2].mean()
    return places if ghost is None else np.concatenate((places, poses(model, ghost)[0]), 1), track


def _surface(model: mujoco.MjModel, is_field: bool, number: int) -> tuple[Array, Array]:
    """Vertices (n, 3) and triangles (m, 3) of a mesh or of a height field's top, in its geom's frame."""
    if not is_field:
        vertices, faces = model.mesh_vert[model.mesh_vertadr[number] :], model.mesh_face[model.mesh_faceadr[number] :]
        return vertices[: model.mesh_vertnum[number]], faces[: model.mesh_facenum[number]]
    shape = rows, columns = model.hfield_nrow[number], model.hfield_ncol[number]
    reach, heights = model.hfield_size[number], model.hfield_data[model.hfield_adr[number] :][: rows * columns]
    y, x = np.meshgrid(*(np.linspace(-r, r, n) for r, n in zip(reach[1::-1], shape, strict=True)), indexing="ij")
    corner = np.arange(rows * columns).reshape(shape)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    return np.stack([x.ravel(), y.ravel(), reach[2] * heights], 1), np.stack([a, b, c, a, c, d], 1).reshape(-1, 3)


def _meshes(surfaces: list[tuple[Array, Array]]) -> list[dict[str, Any]]:
    """Vertices as whole steps (uint16) from an origin, and triangles (uint16), of the smallest cells that fit."""
    step = cell = max((float(np.ptp(vertices, 0).max()) for vertices, _ in surfaces), default=0.0) / 65535
    while True:
        merged = [_merge(*surface, cell) for surface in surfaces]
        size = 6 * sum(len(vertices) + len(faces) for vertices, faces in merged)
        if size <= MESH_BYTES and all(len(vertices) <= 65536 for vertices, _ in merged):
            break
        cell *= 1.3
    packed = []
    for vertices, faces in merged:
        places = ((vertices - vertices.min(0)) / step).round().astype("<u2")
        about = {"origin": _rounded(vertices.min(0)), "step": step}
        packed.append(about | {"vertices": _base64(places), "faces": _base64(faces.astype("<u2"))})
    return packed


def _merge(vertices: Array, faces: Array, cell: float) -> tuple[Array, Array]:
    """The mean of the vertices in each cubic cell, and the triangles that are left (Rossignac and Borrel 1993)."""
    place = ((vertices - vertices.min(0)) / cell).round().astype(np.int64) @ (1, 2**17, 2**34)
    _, number, count = np.unique(place, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(number, column) for column in vertices.T], 1) / count[:, None]
    corners = number[faces]
    return means, corners[(corners != np.roll(corners, 1, axis=1)).all(1)]


def _muscle(model: mujoco.MjModel, tendon: int) -> dict[str, Any]:
    """Its half width and its path: body and point in the body's frame, of each site that it passes."""
    first = model.tendon_adr[tendon]
    steps = range(first, first + model.tendon_num[tendon])
    sites = [model.wrap_objid[k] for k in steps if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_SITE]
    points = [[int(model.site_bodyid[k]), *_rounded(model.site_pos[k])] for k in sites]
    return {"width": float(model.tendon_width[tendon]), "points": points}


def _rounded(values: ArrayLike) -> list[float]:
    return [round(float(value), 5) for value in np.asarray(values)]


def _base64(array: Array) -> str:
    return base64.b64encode(array.tobytes()).decode()

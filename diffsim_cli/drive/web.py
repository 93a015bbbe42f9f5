"""Describe to the page of `diffsim drive` what it draws of a scene; the page itself is web.html."""

from __future__ import annotations

import base64
import html
import json
import re
from importlib.resources import files
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.scene import Scene
from diffsim_cli.render import GHOST, activations, dressed, orbit

HIDDEN_GROUP = 3  # geoms from this group on are not drawn, as in MuJoCo
Array = NDArray[Any]


def fill_page(motion: dict[str, Any], title: str, caption: str) -> str:
    """The page that shows what `describe` found; title and caption may have several lines."""
    page = (files("diffsim_cli.drive") / "web.html").read_text(encoding="utf-8")
    parts = {"title": html.escape(title), "caption": html.escape(caption)}
    parts["motion"] = json.dumps(motion).replace("<", "\\u003c")
    return re.sub(r"\$(title|caption|motion)\b", lambda name: parts[name[1]], page)


def describe(scene: Scene, control_dt: float, ghost: bool = False) -> dict[str, Any]:
    """Describe what keeps its shape: geoms, meshes, ground, muscles (straight from point to point), the camera's orbit.

    control_dt [s] lies between two pictures. A ghost is a second, transparent robot. Terrain is that of the first
    environment.
    """
    model = dressed(scene) or scene.mj_model
    planes, painted = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, model.geom_matid >= 0
    rgba = model.geom_rgba.copy()
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    geoms = []
    for k in np.flatnonzero(~planes & (model.geom_group < HIDDEN_GROUP) & (rgba[:, 3] > 0)).tolist():
        kind = mujoco.mjtGeom(model.geom_type[k]).name.removeprefix("mjGEOM_").lower()
        numbers = {"size": model.geom_size, "pos": model.geom_pos, "quat": model.geom_quat, "rgba": rgba}
        geom = {"body": int(model.geom_bodyid[k]), "type": kind, "mesh": int(model.geom_dataid[k])}
        geoms.append(geom | {name: _rounded(values[k]) for name, values in numbers.items()})
    if ghost:
        moving, colour = [geom for geom in geoms if geom["body"]], {"rgba": _rounded(GHOST)}
        geoms += [geom | colour | {"body": geom["body"] + model.nbody} for geom in moving]
    ground = None
    if scene.terrain is not None:
        ground = [_rounded(vertex) for vertex in scene.terrain[0]]
    elif planes.any():
        ground = [[x, float(model.geom_pos[planes][0, 2])] for x in (0.0, 1.0)]
    return {
        "dt": control_dt,
        "bodies": model.nbody * (1 + ghost),
        "robot": model.nbody,  # bodies, before those of the ghost
        "ground": ground,  # a profile (K, 2) of x and z, whose first and last segment go on for ever
        "geoms": geoms,
        "meshes": [_mesh(model, number) for number in range(model.nmesh)],
        "muscles": [_muscle(model, tendon) for tendon in activations(model, np.zeros(model.nu))[0]],
        "camera": orbit(model),
    }


def poses(model: mujoco.MjModel, *states: Array) -> tuple[Array, Array]:
    """(k, nbody, 7) position and quaternion wxyz of each body in k states qpos (nq,), and (3,) what the camera follows:
    in the first state the centre of mass of the body that carries it."""
    data, carrier = mujoco.MjData(model), model.cam_bodyid[0] if model.ncam else min(1, model.nbody - 1)
    places, tracks = np.empty((len(states), model.nbody, 7)), []
    for place, data.qpos[:] in zip(places, states, strict=True):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        place[:, :3], place[:, 3:] = data.xpos, data.xquat
        tracks.append(data.subtree_com[carrier].copy())
    return places, tracks[0]


def encode(model: mujoco.MjModel, poses: Array, track: Array, ctrl: Array) -> dict[str, str]:
    """A picture: what `poses` found and the muscles' activation by ctrl (nu,), as base64."""
    activation = activations(model, ctrl)[1]
    return {
        "poses": _base64(poses.astype("<f4")),
        "track": _base64(track.astype("<f4")),
        "activation": _base64((activation * 255).round().astype(np.uint8)),
    }


def _mesh(model: mujoco.MjModel, number: int) -> dict[str, str]:
    """Vertices (n, 3) in the frame of its geoms, and triangles (m, 3)."""
    vertices, faces = model.mesh_vert[model.mesh_vertadr[number] :], model.mesh_face[model.mesh_faceadr[number] :]
    vertices, faces = vertices[: model.mesh_vertnum[number]], faces[: model.mesh_facenum[number]]
    return {"vertices": _base64(vertices.astype("<f4")), "faces": _base64(faces.astype("<u4"))}


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

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
from diffsim.view.render import GROUND, activations, orbit, whole_file
from diffsim.view.slabs import slabs

MAX_BYTES = 700_000  # of poses; a longer motion keeps every second control step, or fewer
HIDDEN_GROUP = 3  # geoms from this group on are not drawn, as in MuJoCo
SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder")  # whatever else there is, is drawn as a box


def write_page(
    path: str | os.PathLike[str],
    scene: Scene,
    qpos: ArrayLike,
    control_dt: float,
    ctrl: ArrayLike | None = None,
    title: str = "",
    caption: str = "",
) -> Path:
    """Write a page that plays qpos (T, nq), with muscles coloured by ctrl (T, nu) in [-1, 1]; returns the file.

    A row is a control step of control_dt [s]; the path ends in .html. The page says title and caption, which may have
    several lines. Meshes are drawn as their boxes, muscles straight from point to point.

    Raises:
        ValueError: another suffix.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(f"a page ends in .html, not {path.suffix!r}")
    page = fill_page(describe(scene, qpos, control_dt, ctrl), title, caption)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def fill_page(motion: dict[str, Any], title: str, caption: str) -> str:
    """The page that shows what `describe` found."""
    page = (files("diffsim") / "assets" / "web.html").read_text(encoding="utf-8")
    parts = {"title": html.escape(title), "caption": html.escape(caption)}
    parts["motion"] = json.dumps(motion).replace("<", "\\u003c")
    return re.sub(r"\$(title|caption|motion)\b", lambda name: parts[name[1]], page)


def describe(scene: Scene, qpos: ArrayLike, control_dt: float, ctrl: ArrayLike | None = None) -> dict[str, Any]:
    """What the page draws: shapes once, and of every frame the pose of each body and the activation of each muscle."""
    model, qpos = scene.mj_model, np.asarray(qpos, dtype=np.float64)
    stride = 1 + len(qpos) * model.nbody * 28 // MAX_BYTES
    relaxed = np.full((len(qpos), model.nu), -1.0)
    ctrl = (relaxed if ctrl is None else np.asarray(ctrl))[::stride]
    planes, painted = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, model.geom_matid >= 0
    rgba = model.geom_rgba.copy()
    rgba[painted] = model.mat_rgba[model.geom_matid[painted]]
    geoms = []
    for k in np.flatnonzero(~planes & (model.geom_group < HIDDEN_GROUP) & (rgba[:, 3] > 0)):
        kind = mujoco.mjtGeom(model.geom_type[k]).name.removeprefix("mjGEOM_").lower()
        kind, body = kind if kind in SHAPES else "box", model.geom_bodyid[k]
        geoms.append(_shape(kind, body, model.geom_size[k], model.geom_pos[k], model.geom_quat[k], rgba[k]))
    for size, centre, rotation in [] if scene.terrain is None else slabs(scene.terrain[0]):  # the first profile
        mujoco.mju_mat2Quat(quat := np.empty(4), rotation.ravel())
        geoms.append(_shape("box", 0, size, centre, quat, GROUND))
    return {
        "dt": stride * control_dt,
        "frames": len(ctrl),
        "bodies": model.nbody,
        "floor": float(model.geom_pos[planes][0, 2]) if planes.any() and scene.terrain is None else None,
        "geoms": geoms,
        "muscles": [_muscle(model, tendon) for tendon in activations(model, ctrl)[0]],
        "camera": orbit(model),
        **frames(model, qpos[::stride], ctrl),
    }


def frames(model: mujoco.MjModel, qpos: NDArray[np.float64], ctrl: NDArray[Any]) -> dict[str, str]:
    """What moves, of configurations qpos (T, nq) with ctrl (T, nu): numbers in the page's order, as base64."""
    poses, track = _poses(model, qpos)
    activation = activations(model, ctrl)[1]
    return {
        "poses": _base64(poses.astype("<f4")),
        "track": _base64(track.astype("<f4")),
        "activation": _base64((activation * 255).round().astype(np.uint8)),
    }


def _poses(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(T, nbody, 7) position and quaternion wxyz of each body, and (T, 3) what the camera follows.

    That is the centre of mass of the body that carries the camera, at its mean height, so that the picture keeps still.
    """
    data, carrier = mujoco.MjData(model), model.cam_bodyid[0] if model.ncam else min(1, model.nbody - 1)
    poses, track = np.empty((len(qpos), model.nbody, 7)), np.empty((len(qpos), 3))
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        poses[t, :, :3], poses[t, :, 3:], track[t] = data.xpos, data.xquat, data.subtree_com[carrier]
    track[:, 2] = track[:, 2].mean()
    return poses, track


def _shape(kind: str, body: int, size: ArrayLike, pos: ArrayLike, quat: ArrayLike, rgba: ArrayLike) -> dict[str, Any]:
    numbers = {"size": size, "pos": pos, "quat": quat, "rgba": rgba}
    return {"type": kind, "body": int(body)} | {name: _rounded(values) for name, values in numbers.items()}


def _muscle(model: mujoco.MjModel, tendon: int) -> dict[str, Any]:
    """Its half width and its path: body and point in the body's frame, of each site that it passes."""
    first = model.tendon_adr[tendon]
    steps = range(first, first + model.tendon_num[tendon])
    sites = [model.wrap_objid[k] for k in steps if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_SITE]
    points = [[int(model.site_bodyid[k]), *_rounded(model.site_pos[k])] for k in sites]
    return {"width": float(model.tendon_width[tendon]), "points": points}


def _rounded(values: ArrayLike) -> list[float]:
    return [round(float(value), 5) for value in np.asarray(values)]


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(array.tobytes()).decode()
